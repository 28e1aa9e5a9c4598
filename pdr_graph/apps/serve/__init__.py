"""Live phones on a map: the server of ``pdr-graph serve``."""
