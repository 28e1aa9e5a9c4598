"""The building."""
