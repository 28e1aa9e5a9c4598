"""Inertial sensors, magnetometer and barometer: from samples to attitude, north and height changes."""
