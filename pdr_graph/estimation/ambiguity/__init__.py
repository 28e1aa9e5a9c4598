"""What may be wrong with a walk or its sources: hypotheses, solved and weighed by their evidence."""
