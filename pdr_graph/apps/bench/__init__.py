"""A bench: data sets × what is given × methods, in one table."""
