"""The maps that show a day: one for each floor, one of all that was outdoors, and larger ones of small places.

Colours, letters and words that the parts of a day's picture have in common are here too.
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

from pdr_graph.errors import one_line
from pdr_graph.frames import Frame, enu
from pdr_graph.lifelog.day import GAP, PRIVATE, STANDING, VEHICLE, WALKING, Day, Outing, Stay, part, stretches
from pdr_graph.lifelog.timeline import PASSING, STAY
from pdr_graph.plotting import FIX, GREY, RADIO, TRACK
from pdr_graph.types import Array, Trajectory

SURROUNDINGS = 0.12  # share of what is shown around it
SMALLEST, SMALLEST_OUTDOORS = 40.0, 150.0  # [m] shown, however little was walked
APART = 300.0  # [m] between places that have maps of their own
TOO_SMALL = 0.3  # share of the whole map's width below which a place is drawn again, larger
LEAST_TIME = 300.0  # [s] in a place that is drawn again
MOST_PLACES = 4  # that are, those with the longest time in them
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


@dataclass(frozen=True)
class Drawn:
    """A part of an outing on a map: of one kind, on one floor; of a GAP the two rows about it. Times are Unix times."""

    kind: str
    floor: str
    track: Trajectory


@dataclass(frozen=True)
class Panel:
    """One map. letter: its name, "" of the only one; plan: path, "" without one; floor: label, "" of any.

    ways: of each outing, each stretch without a break; drawn: the same by kinds, and the gaps; stays. All that there
    is in its frame, of which it shows what lies in ``corners (2, 2)`` [m].
    """

    frame: Frame
    plan: str
    floor: str
    corners: Array
    ways: tuple[tuple[Trajectory, ...], ...]
    drawn: tuple[Drawn, ...]
    stays: tuple[Stay, ...]
    letter: str = ""

    @property
    def width(self) -> float:
        """The longer side. [m]"""
        return float(np.max(self.corners[1] - self.corners[0]))

    @property
    def starts(self) -> tuple[Trajectory, ...]:
        """The first row of each outing."""
        return tuple(own[0][0] for own in self.ways if own)


def panels(day: Day) -> tuple[Panel, ...]:
    """The maps of a day, that of all that was outdoors first."""
    outings = [outing for outing in day.outings if stretches(outing)]
    outdoors = [o for o in outings if not o.plan]
    located = [o for o in outdoors if o.frame.georeferenced]
    whole = [_panel([o for o in outings if o.frame.georeferenced], _about(located[0]))] if located else []
    nowhere = [_panel([o], o.frame) for o in outdoors if not o.frame.georeferenced]
    found = [*whole, *(place for panel in whole for place in _places(panel)), *nowhere, *_floors(outings)]
    letters = LETTERS[: len(found)] if len(found) > 1 else ("",)
    return tuple(replace(panel, letter=letter) for panel, letter in zip(found, letters, strict=False))


def _about(outing: Outing) -> Frame:
    """East-north about where an outing began."""
    lon, lat = outing.frame.to_lonlat(outing.trajectory.position[:1])[0].tolist()
    return enu(lat, lon)


def _panel(outings: Sequence[Outing], frame: Frame, plan: str = "", floor: str = "") -> Panel:
    """A map of some outings; floor: only what was on it."""
    ways = [[_in(frame, o, track) for track, _ in stretches(o)] for o in sorted(outings, key=lambda o: o.epoch)]
    every = [way for own in ways for way in own]
    drawn = [d for o in outings for d in _drawn(o, frame) if floor in ("", d.floor)]
    drawn += [d for pair in pairwise(every) if floor in ("", (d := _gap(*pair)).floor)]
    stays = tuple(_moved(s, o.frame, frame) for o in outings for s in o.stays if floor in ("", s.floor))
    least = SMALLEST if plan else SMALLEST_OUTDOORS
    corners = _around(np.concatenate([d.track.position for d in drawn]), least)
    return Panel(frame, plan, floor, corners, tuple(map(tuple, ways)), tuple(drawn), stays)


def _floors(outings: Sequence[Outing]) -> Iterator[Panel]:
    """A map for each floor of each plan."""
    for plan in dict.fromkeys(outing.plan for outing in outings if outing.plan):
        own = [outing for outing in outings if outing.plan == plan]
        for floor in dict.fromkeys(d.floor for o in own for d in _drawn(o, o.frame)):
            yield _panel(own, own[0].frame, plan, floor)


def _places(whole: Panel) -> list[Panel]:
    """What lies together on a map and is small on it, without what was ridden."""
    own = [d for d in whole.drawn if d.kind not in (VEHICLE, GAP)]
    if not own:
        return []
    low, high = (np.array([end(d.track.position, axis=0) for d in own]) for end in (np.min, np.max))
    gaps = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)  # < 0 of boxes that overlap
    _, group = connected_components(coo_array(gaps < APART))
    found = [[d for d, g in zip(own, group, strict=True) if g == n] for n in range(int(group.max()) + 1)]
    found = [g for g in found if not any(d.floor for d in g)]  # what is on a plan is drawn there
    positions = [np.concatenate([d.track.position for d in g]) for g in found]
    close = [replace(whole, corners=_around(own, SMALLEST_OUTDOORS)) for own in positions]
    times = [sum(float(np.ptp(d.track.time)) for d in g) for g in found]
    order = sorted(range(len(found)), key=lambda n: -times[n])
    small = [n for n in order if close[n].width < TOO_SMALL * whole.width and times[n] > LEAST_TIME]
    return [close[n] for n in sorted(small[:MOST_PLACES])]


def _drawn(outing: Outing, frame: Frame) -> Iterator[Drawn]:
    """What an outing is made of on a map."""
    for track, segments in stretches(outing):
        line = _in(frame, outing, track)
        for segment in segments:
            own = part(line, segment.start + outing.epoch, segment.end + outing.epoch)
            for piece in _by_floor(own):
                yield Drawn(segment.kind, piece.floor[-1], piece)


def _gap(before: Trajectory, after: Trajectory) -> Drawn:
    """From the last row of one to the first of the other."""
    ends = before[-1], after[0]
    time, position, heading = (np.concatenate([getattr(e, n) for e in ends]) for n in ("time", "position", "heading"))
    (one,), (other,) = (end.floor for end in ends)
    return Drawn(GAP, one if one == other else "", Trajectory(time, position, heading, (one, other)))


def _in(frame: Frame, outing: Outing, track: Trajectory) -> Trajectory:
    return replace(track, time=track.time + outing.epoch, position=frame.from_frame(outing.frame, track.position))


def _moved(stay: Stay, old: Frame, new: Frame) -> Stay:
    return replace(stay, position=new.from_frame(old, stay.position[None])[0])


def _by_floor(track: Trajectory) -> Iterator[Trajectory]:
    """Parts on one floor; a change of floor belongs to both."""
    changes = [n for n, (one, other) in enumerate(pairwise(track.floor), 1) if one != other]
    for first, last in pairwise([0, *changes, len(track)]):
        if last > first:
            yield track[max(first - 1, 0) : last]


def _around(position: Array, least: float) -> Array:
    """Corners ``(2, 2)`` of what is shown of a map with positions ``(n, 2)``, and of at least so much. [m]"""
    low, high = position.min(axis=0), position.max(axis=0)
    half = np.maximum((high - low) * (0.5 + SURROUNDINGS), least / 2)
    return np.stack([(low + high) / 2 - half, (low + high) / 2 + half])


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
