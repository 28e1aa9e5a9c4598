"""Published methods for comparison; only experiments use them, the rest of the package does not import them."""
