"""What a build could not finish because its workers were lost, for its last message."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from pdr_graph.errors import count, one_line

MAX_NAMES = 5  # recordings named in a message


def unfinished_lines(reason: str, recordings: Sequence[str], days: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """A line for the recordings that were not observed, and one for the days (person, date) that were not built."""
    lines: list[str] = []
    if recordings:
        more = [f"and {len(recordings) - MAX_NAMES} more"] if len(recordings) > MAX_NAMES else []
        names = ", ".join([*recordings[:MAX_NAMES], *more])
        lines.append(f"{reason}: {count(len(recordings), 'recording')} not observed, left to the next build: {names}")
    if days:
        names = ", ".join(_spans(days))
        lines.append(f"{reason}: {count(len(days), 'person-day')} not built, left to the next build: {names}")
    return tuple(lines)


def _spans(days: Sequence[tuple[str, str]]) -> list[str]:
    """Each person with the first and last date and the number of days."""
    dates = defaultdict[str, list[str]](list)
    for person, date in sorted(days):
        dates[person].append(date)
    return [
        f"{one_line(person)} {own[0]}" + (f" to {own[-1]} ({len(own)})" if len(own) > 1 else "")
        for person, own in dates.items()
    ]
