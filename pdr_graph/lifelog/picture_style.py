"""What the parts of a day's picture have in common: colours, letters and words."""

from __future__ import annotations

from matplotlib import rcParams
from matplotlib.font_manager import fontManager
from matplotlib.patheffects import Normal, Stroke

from pdr_graph.errors import one_line
from pdr_graph.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.lifelog.parts import PRIVATE
from pdr_graph.lifelog.timeline import PASSING, STAY
from pdr_graph.plotting import FIX, GREY, RADIO, TRACK

COLOURS = {WALKING: TRACK, VEHICLE: FIX, STANDING: "#3f9c8f", STAY: RADIO, PASSING: "#b9a3d0", GAP: GREY, PRIVATE: GREY}
INK, HALO = "#2b2440", [Stroke(linewidth=2.2, foreground="white", alpha=0.85), Normal()]
LABEL = 7.5  # [pt]
LETTER = 0.6 * LABEL  # [pt] width of one, on average and a little more
FONTS = (  # that have Chinese, Japanese or Korean names, where there are any
    "Noto Sans CJK JP",
    "Noto Sans JP",
    "Hiragino Sans",
    "Yu Gothic",
    "Microsoft YaHei",
    "PingFang SC",
    "WenQuanYi Zen Hei",
    "Malgun Gothic",
)
WIDE_LETTERS = 0x2E80  # from which on they are twice as wide: Chinese, Japanese, Korean
LONGEST_NAME = 26  # letters


def families() -> list[str]:
    """The fonts to draw with: the usual one, and those that there are for what it lacks."""
    return [*rcParams["font.family"], *(name for name in FONTS if name in set(fontManager.get_font_names()))]


def short(name: str) -> str:
    """A name on one line, cut where it is too long for a label."""
    plain = one_line(name)
    return plain if len(plain) <= LONGEST_NAME else f"{plain[: LONGEST_NAME - 1]}…"


def width(text: str) -> float:
    """About how wide a label is. [pt]"""
    return LETTER * sum(1 + (ord(letter) > WIDE_LETTERS) for letter in text)
