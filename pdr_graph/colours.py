"""Colours and margin that pictures and reports share; this module does not load Matplotlib."""

from pdr_graph.floor.cells import CLOSED, DOOR

SOLID_FILL, BORDER, EDGE, OUTSIDE, WALKABLE = "#c9c4bb", "#a8a196", "#8d877c", "#efece6", "#ffffff"
ROOM, OPENING, STAIRS = "#f4f6f0", "#e8c9a8", "#ebe3c8"
CELLS = ((CLOSED, ROOM), ((DOOR,), OPENING), (("stairs",), STAIRS))  # colours of kinds of cells
TRACK, BAND, GREY, FIX, TRUTH, RADIO = "#1f5fbf", "#7fb0f0", "#8a8a8a", "#d1602b", "#111111", "#7b4fa6"
OTHER = "#b0458a"  # other routes
SURROUNDINGS = 0.12  # share of the walk's size shown around it
