"""The maps of a day: one per floor, one of everything outdoors, and enlarged ones of small places.

The colours, fonts and labels that the parts of a day's picture share are here too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from matplotlib import rcParams
from matplotlib.font_manager import fontManager
from matplotlib.patheffects import Normal, Stroke
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.errors import count, one_line
from pdr_graph.frames import Frame, enu
from pdr_graph.lifelog.day import GAP, PRIVATE, STANDING, VEHICLE, WALKING, Day, Outing, Stay, clipped, split_at_gaps
from pdr_graph.lifelog.timeline import PASSING, STAY
from pdr_graph.report.page import FIX, GREY, RADIO, TRACK
from pdr_graph.types import Array, OneLineRepr, Trajectory

# Chosen by hand
MARGIN_SHARE = 0.12  # of the size of the content, on each side of a map
MIN_SIZE_INDOORS, MIN_SIZE_OUTDOORS = 40.0, 150.0  # [m] of a map
ENLARGED_SHARE = 0.3  # of the whole map's width, below which a place is drawn again on a larger map
PANEL_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


@dataclass(frozen=True)
class DrawnPart(OneLineRepr):
    """A part of an outing on a map, of one kind and on one floor; a gap has the rows before and after it.

    Times of the track are Unix times [s].
    """

    kind: str
    floor: str
    track: Trajectory

    def _summary(self) -> list[str]:
        return [self.kind, *filter(None, [self.floor]), repr(self.track)]


@dataclass(frozen=True)
class Panel(OneLineRepr):
    """One map of a day.

    frame: of all positions; plan: path, "" without one; floor: label, "" for any; corners: ``(2, 2)`` of the shown area
    [m]; ways: of each outing, the tracks without gaps; drawn: these tracks by kind and floor, and the gaps; stays;
    letter: name of the map, "" if it is the only one. Tracks and stays may lie outside the shown area.
    """

    frame: Frame
    plan: str
    floor: str
    corners: Array
    ways: tuple[tuple[Trajectory, ...], ...]
    drawn: tuple[DrawnPart, ...]
    stays: tuple[Stay, ...]
    letter: str = ""

    def _summary(self) -> list[str]:
        names = [name for name in (self.letter, self.floor) if name]
        return [*names, f"{self.width:.0f} m", count(len(self.ways), "outing"), count(len(self.stays), "stay")]

    @property
    def width(self) -> float:
        """The longer side of the shown area [m]."""
        return float(np.max(self.corners[1] - self.corners[0]))

    @property
    def starts(self) -> tuple[Trajectory, ...]:
        """The first row of each outing."""
        return tuple(own[0][0] for own in self.ways if own)


def panels(day: Day) -> tuple[Panel, ...]:
    """The maps of a day, first the map of everything outdoors."""
    outings = [outing for outing in day.outings if split_at_gaps(outing)]
    outdoors = [o for o in outings if not o.plan]
    located = [o for o in outdoors if o.frame.georeferenced]
    whole = [_panel([o for o in outings if o.frame.georeferenced], _local_frame(located[0]))] if located else []
    nowhere = [_panel([o], o.frame) for o in outdoors if not o.frame.georeferenced]
    found = [
        *whole,
        *(place for panel in whole for place in _enlarged_places(panel)),
        *nowhere,
        *_floor_panels(outings),
    ]
    letters = PANEL_LETTERS[: len(found)] if len(found) > 1 else ("",)
    return tuple(replace(panel, letter=letter) for panel, letter in zip(found, letters, strict=False))


def _local_frame(outing: Outing) -> Frame:
    """The east-north frame about the start of an outing."""
    lon, lat = outing.frame.to_lonlat(outing.trajectory.position[:1])[0].tolist()
    return enu(lat, lon)


def _panel(outings: Sequence[Outing], frame: Frame, plan: str = "", floor: str = "") -> Panel:
    """A map of some outings; floor: label of the only floor shown, "" for all."""
    ways = [
        [_in_frame(frame, o, track) for track, _ in split_at_gaps(o)] for o in sorted(outings, key=lambda o: o.epoch)
    ]
    every = [way for own in ways for way in own]
    drawn = [d for o in outings for d in _drawn_parts(o, frame) if floor in ("", d.floor)]
    drawn += [d for pair in pairwise(every) if floor in ("", (d := _gap(*pair)).floor)]
    stays = tuple(_converted_stay(s, o.frame, frame) for o in outings for s in o.stays if floor in ("", s.floor))
    least = MIN_SIZE_INDOORS if plan else MIN_SIZE_OUTDOORS
    corners = _corners_around(np.concatenate([d.track.position for d in drawn]), least)
    return Panel(frame, plan, floor, corners, tuple(map(tuple, ways)), tuple(drawn), stays)


def _floor_panels(outings: Sequence[Outing]) -> Iterator[Panel]:
    """A map for each floor of each plan."""
    for plan in dict.fromkeys(outing.plan for outing in outings if outing.plan):
        own = [outing for outing in outings if outing.plan == plan]
        for floor in dict.fromkeys(d.floor for o in own for d in _drawn_parts(o, o.frame)):
            yield _panel(own, own[0].frame, plan, floor)


def _enlarged_places(whole: Panel) -> list[Panel]:
    """Enlarged maps of the small places on a map, without rides."""
    own = [d for d in whole.drawn if d.kind not in (VEHICLE, GAP)]
    if not own:
        return []
    low, high = (np.array([end(d.track.position, axis=0) for d in own]) for end in (np.min, np.max))
    gaps = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)  # < 0 for boxes that overlap
    _, group = connected_components(coo_array(gaps < 300.0))  # place distance [m] between places with maps of their own
    found = [[d for d, g in zip(own, group, strict=True) if g == n] for n in range(int(group.max()) + 1)]
    found = [g for g in found if not any(d.floor for d in g)]  # places on a plan are drawn on the plan
    positions = [np.concatenate([d.track.position for d in g]) for g in found]
    close = [replace(whole, corners=_corners_around(own, MIN_SIZE_OUTDOORS)) for own in positions]
    times = [sum(float(np.ptp(d.track.time)) for d in g) for g in found]
    order = sorted(range(len(found)), key=lambda n: -times[n])
    # least place time [s] in a place that is drawn again
    small = [n for n in order if close[n].width < ENLARGED_SHARE * whole.width and times[n] > 300.0]
    # most places that are drawn again: those with the longest time in them
    return [close[n] for n in sorted(small[:4])]


def _drawn_parts(outing: Outing, frame: Frame) -> Iterator[DrawnPart]:
    """The tracks of an outing by kind and floor."""
    for track, segments in split_at_gaps(outing):
        line = _in_frame(frame, outing, track)
        for segment in segments:
            own = clipped(line, segment.start + outing.epoch, segment.end + outing.epoch)
            for piece in _by_floor(own):
                yield DrawnPart(segment.kind, piece.floor[-1], piece)


def _gap(before: Trajectory, after: Trajectory) -> DrawnPart:
    """The gap between two tracks: the last row of one and the first row of the other."""
    ends = before[-1], after[0]
    time, position, heading = (np.concatenate([getattr(e, n) for e in ends]) for n in ("time", "position", "heading"))
    (one,), (other,) = (end.floor for end in ends)
    return DrawnPart(GAP, one if one == other else "", Trajectory(time, position, heading, (one, other)))


def _in_frame(frame: Frame, outing: Outing, track: Trajectory) -> Trajectory:
    """A track of an outing in another frame, with Unix times [s]."""
    return replace(track, time=track.time + outing.epoch, position=frame.from_frame(outing.frame, track.position))


def _converted_stay(stay: Stay, old: Frame, new: Frame) -> Stay:
    return replace(stay, position=new.from_frame(old, stay.position[None])[0])


def _by_floor(track: Trajectory) -> Iterator[Trajectory]:
    """The parts of a track on one floor each; both parts share the row of a change."""
    changes = [n for n, (one, other) in enumerate(pairwise(track.floor), 1) if one != other]
    for first, last in pairwise([0, *changes, len(track)]):
        if last > first:
            yield track[max(first - 1, 0) : last]


def _corners_around(position: Array, least: float) -> Array:
    """Corners ``(2, 2)`` of the shown area about positions ``(n, 2)``, with sides of at least `least` [m]."""
    low, high = position.min(axis=0), position.max(axis=0)
    half = np.maximum((high - low) * (0.5 + MARGIN_SHARE), least / 2)
    return np.stack([(low + high) / 2 - half, (low + high) / 2 + half])


COLOURS = {WALKING: TRACK, VEHICLE: FIX, STANDING: "#3f9c8f", STAY: RADIO, PASSING: "#b9a3d0", GAP: GREY, PRIVATE: GREY}
INK, HALO = "#2b2440", [Stroke(linewidth=2.2, foreground="white", alpha=0.85), Normal()]
LABEL_SIZE = 7.5  # [pt]
LETTER_WIDTH = 0.6 * LABEL_SIZE  # [pt] slightly more than the average
CJK_FONTS = (  # with Chinese, Japanese and Korean letters; those that are installed are used
    "Noto Sans CJK JP",
    "Noto Sans JP",
    "Hiragino Sans",
    "Yu Gothic",
    "Microsoft YaHei",
    "PingFang SC",
    "WenQuanYi Zen Hei",
    "Malgun Gothic",
)
MAX_NAME_LENGTH = 26  # letters of a label


def font_families() -> list[str]:
    """The font families to draw with: the default, and the installed ones for letters that it lacks."""
    return [*rcParams["font.family"], *(name for name in CJK_FONTS if name in set(fontManager.get_font_names()))]


def short_name(name: str) -> str:
    """A name on one line, shortened to MAX_NAME_LENGTH letters."""
    plain = one_line(name)
    return plain if len(plain) <= MAX_NAME_LENGTH else f"{plain[: MAX_NAME_LENGTH - 1]}…"


def label_width(text: str) -> float:
    """Approximate width of a label [pt]."""
    # first wide letter: code point from which letters are twice as wide: Chinese, Japanese, Korean
    return LETTER_WIDTH * sum(1 + (ord(letter) > 0x2E80) for letter in text)
