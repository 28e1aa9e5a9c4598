"""Floor plans: areas, walls, distance fields, networks and buildings."""
