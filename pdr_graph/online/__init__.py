"""The live walk: navigator, journal, the competition's client."""
