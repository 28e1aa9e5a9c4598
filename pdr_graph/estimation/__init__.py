"""The inference: steps, fixes and the building to the most probable walk."""
