"""What experiments need: simulated walks and the systems of the papers."""
