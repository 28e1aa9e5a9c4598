"""What the layers of a CAD drawing hold, by their names in some languages."""

from __future__ import annotations

import re

WALLS, DOORS, STAIRS, IGNORED, UNKNOWN = "walls", "doors", "stairs", "ignored", "unknown"
# Parts of names, the first that fits decides: "A-WALL", "A-DOOR", "I-FURN" of the AIA; German, French, Spanish, Italian
NAMES = (
    (IGNORED, r"text|txt|anno|label|dim\b|dims|dimen|bema|maß|cota|cote|quota|grid|axis|achse|raster|hatch|schraff"),
    (IGNORED, r"furn|möbel|moebel|mobel|mobil|equip|einricht|elec|elektr|light|lamp|plumb|sanit|hvac|heiz|duct|pipe"),
    (IGNORED, r"title|border|frame|rahmen|viewport|defpoints|logo|legend|north|symb|area|room.?name|tree|baum|topo"),
    (DOORS, r"door|tür|tuer|\btur\b|porte|puerta|\bporta|drzwi|deur"),
    (STAIRS, r"stair|trepp|escal|\bscal|step|stufe|ramp|rolltr"),
    (WALLS, r"wall|wand|wänd|waend|mauer|\bmur|muro|parede|pared|column|\bcol\b|stütz|stuetz|säule|pillar|colonn"),
    (
        WALLS,
        r"window|fenster|fenetre|fenêtre|ventana|finestra|glaz|glas|facade|fassade|railing|gelaender|geländer|core",
    ),
)


def holds(name: str) -> str:
    """What a layer or a block of this name holds: WALLS, DOORS, STAIRS, IGNORED or UNKNOWN."""
    for kind, pattern in NAMES:
        if re.search(pattern, name.casefold()):
            return kind
    return UNKNOWN
