"""A day as a list that fits a screen: the shortest entries are merged with their neighbours, and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from pdr_graph.errors import count, one_line
from pdr_graph.lifelog.day import GAP, PRIVATE, STANDING, VEHICLE, WALKING
from pdr_graph.lifelog.place_visits import DAY_LENGTH, place_label
from pdr_graph.lifelog.timeline import KIND_NAMES, PASSING, STAY, TimelineEntry, duration_text, entry_texts
from pdr_graph.types import OneLineRepr

MOST_ROWS = 25  # of a list that fits a screen
MERGED_NAMES = {
    STAY: "short stop",
    STANDING: "short stop",
    PASSING: "slow pass",
    WALKING: "short walk",
    VEHICLE: "short ride",
    GAP: "short gap",
    PRIVATE: "short gap",
}
SHORTEST_MINUTES = 60.0  # [s] of the shortest row of a list whose times are in minutes
MOST_NAMES = 2  # kinds of merged entries that a row names
TRAVEL = (WALKING, PASSING, VEHICLE)


@dataclass(frozen=True)
class ListRow(OneLineRepr):
    """A row of the list. start, end: Unix times [s]; distance: of the entry and of what was merged with it [m].

    entry: the row's own; merged: how many entries of each of MERGED_NAMES are in it too.
    """

    entry: TimelineEntry
    start: float
    end: float
    distance: float
    merged: Counter[str] = field(default_factory=Counter)

    def _summary(self) -> list[str]:
        return [self.entry.kind, duration_text(self.duration), *self.merged]

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.end - self.start

    @property
    def identity(self) -> tuple[object, ...]:
        """Equal for rows that are one if nothing is between them."""
        entry = self.entry
        if entry.kind != STAY:
            return (entry.kind,)
        return (STAY, entry.place_number, entry.place) if entry.place_number >= 0 else (STAY, entry.x, entry.y)


def day_list(entries: Sequence[TimelineEntry], most: int = MOST_ROWS) -> list[ListRow]:
    """At most `most` rows (at least one) of the entries of a day; the shortest are merged with their neighbours."""
    rows = [ListRow(entry, entry.start, entry.end, entry.distance) for entry in entries]
    while len(rows) > max(most, 1):
        shortest = min(range(len(rows)), key=lambda n: rows[n].duration)
        rows[max(shortest - 1, 0) : shortest + 2] = _merged(rows, shortest)
    return rows


def _merged(rows: Sequence[ListRow], n: int) -> list[ListRow]:
    """The rows from n - 1 to n + 1, where row n is merged with one of the others, or with both if they are one."""
    row, before, after = rows[n], rows[n - 1 : n] if n else [], rows[n + 1 : n + 2]
    if before and after and before[0].identity == after[0].identity:
        both = _absorbed(before[0], row)
        joined = replace(both, end=after[0].end, distance=both.distance + after[0].distance)
        return [replace(joined, merged=both.merged + after[0].merged)]
    larger = max([*before, *after], key=lambda r: (r.entry.kind in TRAVEL, r.duration))
    one = _absorbed(larger, row)
    return [one, *after] if before and larger is before[0] else [*before, one]


def _absorbed(row: ListRow, short: ListRow) -> ListRow:
    """The row with a neighbour as a part of it."""
    merged = row.merged + short.merged + Counter([MERGED_NAMES[short.entry.kind]])
    start, end = min(row.start, short.start), max(row.end, short.end)
    return replace(row, start=start, end=end, distance=row.distance + short.distance, merged=merged)


def list_texts(entries: Sequence[TimelineEntry], most: int = MOST_ROWS) -> list[tuple[str, str, str, str, str, str]]:
    """The list of a day as texts; times have seconds if a row is shorter than SHORTEST_MINUTES."""
    rows = day_list(entries, most)
    seconds = any(row.duration < SHORTEST_MINUTES for row in rows)
    return [row_texts(row, seconds) for row in rows]


def row_texts(row: ListRow, seconds: bool = False) -> tuple[str, str, str, str, str, str]:
    """Texts of a row: local start and end, duration, activity, distance, place with what was merged."""
    entry = row.entry
    far = distance_text(row.distance) if entry.kind in TRAVEL and row.distance >= 0.5 else ""
    words = [_place(entry), "corrected" if entry.corrected else "", _merged_text(row.merged)]
    return (
        clock_text(row.start, entry.offset, seconds),
        _end_text(row, seconds),
        duration_text(row.duration),
        entry.mode or KIND_NAMES.get(entry.kind, entry.kind),
        far,
        "; ".join(filter(None, words)),
    )


def _end_text(row: ListRow, seconds: bool) -> str:
    """Local end; with "+1" if it is on the next date, after a flight over time zones."""
    start, end = row.start + row.entry.offset, row.end + row.entry.end_offset
    later = int(end // DAY_LENGTH - start // DAY_LENGTH) if end % DAY_LENGTH > 0 else 0
    return clock_text(row.end, row.entry.end_offset, seconds) + (f" +{later}" if later else "")


def _place(entry: TimelineEntry) -> str:
    """Floors and place: the name that the person gave, else places on a plan with probabilities, else its number."""
    facing = max((part.facing for part in (entry, *entry.parts)), key=lambda own: own[0][1] if own else 0.0)
    on_plan = bool(facing) and entry.place in ("", facing[0][0])
    shown = replace(entry, corrected=False)
    _, _, _, floor, where = entry_texts(replace(shown, facing=facing, place="") if on_plan else shown)
    label = "" if on_plan else one_line(place_label(entry.place, entry.place_number))
    return " ".join(filter(None, [floor and f"floor {floor}", label or where]))


def _merged_text(merged: Counter[str]) -> str:
    """What was merged: ``and 3 short stops, 1 short walk``; the rarer kinds are ``5 others``."""
    common = merged.most_common()
    texts = [_count(number, name) for name, number in common[:MOST_NAMES]]
    others = sum(number for _, number in common[MOST_NAMES:])
    texts += [count(others, "other")] if others else []
    return f"and {', '.join(texts)}" if texts else ""


def _count(number: int, name: str) -> str:
    return f"{number} slow passes" if name == "slow pass" and number > 1 else count(number, name)


def clock_text(time: float, offset: float, seconds: bool = False) -> str:
    """Local time of day of a Unix time [s] at an offset from UTC [s]: ``07:42``, or ``07:42:15``."""
    moment = datetime.fromtimestamp(round(time + offset), UTC)
    return f"{moment:%H:%M:%S}" if seconds else f"{moment:%H:%M}"


def distance_text(metres: float) -> str:
    """A distance as a text: ``640 m``, ``6.2 km``, ``1,250 km``."""
    if metres < 999.5:
        return f"{metres:.0f} m"
    return f"{metres / 1000:.1f} km" if metres < 99_950 else f"{metres / 1000:,.0f} km"
