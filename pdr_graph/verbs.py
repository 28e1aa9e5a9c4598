"""What all verbs of the command line have in common: their exit codes, and where they say to look."""

from __future__ import annotations

from pathlib import Path

RefusedExit, DegradedExit = 2, 3
PAGES = ("report.html", "figure.png", "day.png")  # what to look at first; a picture where there is no page


def first_look(folder: Path) -> Path:
    """What of a folder of results to look at; the folder itself if there is nothing to be seen."""
    return next((folder / page for page in PAGES if (folder / page).exists()), folder)
