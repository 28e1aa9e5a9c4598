"""The live walk: navigator, journal and replay."""
