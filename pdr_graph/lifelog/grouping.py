"""Which recordings of a day are one outing: those that follow one another with short gaps, in frames that fit."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from pdr_graph.lifelog.observation import FEWEST, Observation

LONGEST_GAP = 600.0  # [s] over which recordings are still one outing: beyond, they may have gone anywhere
OVERLAP = 1.0  # [s] by which a recording may begin before the one before has ended

Named = tuple[str, Observation]


@dataclass(frozen=True)
class Group:
    """The recordings of one outing, in order of time, each with its content hash.

    beside: of positions alone, from the same time; notes: what was left out.
    """

    parts: tuple[Named, ...]
    beside: tuple[Named, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def observations(self) -> list[Observation]:
        """The recordings themselves."""
        return [one for _, one in self.parts]

    @property
    def names(self) -> tuple[str, ...]:
        """Content hashes of all that it is made of."""
        return tuple(dict.fromkeys(name for name, _ in (*self.parts, *self.beside)))

    @property
    def epoch(self) -> float:
        """Unix time of its start [s]."""
        return self.parts[0][1].epoch

    @property
    def end(self) -> float:
        """Unix time of its end [s]."""
        return end_of(self.parts[-1][1])


def groups_of(observations: Mapping[str, Observation]) -> list[Group]:
    """The outings of a day, in order of time.

    Positions alone (a watch's) from a time at which there are steps too are fixes of that walk. Nobody walks twice at a
    time: of recordings with steps that overlap the earlier counts.
    """
    ordered = sorted(observations.items(), key=lambda item: (item[1].epoch, item[0]))
    walks = list(_consecutive([item for item in ordered if item[1].steps is not None]))
    alone: list[Named] = []
    for name, one in ordered:
        if one.steps is None:
            walks, rest = _shared_out(name, one, walks)
            alone += rest
    begins = [walk.epoch for walk in walks]
    between = groupby(sorted(alone, key=lambda item: item[1].epoch), lambda item: bisect(begins, item[1].epoch))
    return sorted([*walks, *(group for _, own in between for group in _consecutive(list(own)))], key=_epoch)


def _epoch(group: Group) -> float:
    return group.epoch


def end_of(one: Observation) -> float:
    """Unix time of a recording's end [s]."""
    return one.epoch + one.duration


def _consecutive(parts: Sequence[Named]) -> Iterator[Group]:
    """Recordings with short gaps between them, on one plan or without one."""
    group: Group | None = None
    for name, one in parts:
        if group is not None and one.epoch < group.end - OVERLAP and one.steps is not None:
            said = f"{one.source}: left out, it was recorded while {group.parts[-1][1].source} was"
            group = replace(group, notes=(*group.notes, said))
        elif group is not None and _follows(group, one):
            group = replace(group, parts=(*group.parts, (name, one)))
        else:
            if group is not None:
                yield group
            group = Group(((name, one),))
    if group is not None:
        yield group


def _follows(group: Group, one: Observation) -> bool:
    last = group.parts[-1][1]
    placed = [part for part in (*group.observations, one) if len(part.fixes)]
    one_frame = all(part.frame.georeferenced for part in placed) or all(part.frame == one.frame for part in placed)
    return one.epoch - group.end <= LONGEST_GAP and last.plan == one.plan and one_frame


def _shared_out(name: str, one: Observation, walks: Sequence[Group]) -> tuple[list[Group], list[Named]]:
    """Positions given to the walks of their time, and the stretches that are left."""
    time = one.epoch + one.fixes.time
    spans = np.array([(walk.epoch, walk.end) for walk in walks]).reshape(-1, 2)
    during = [np.flatnonzero((time >= begin) & (time <= end)) for begin, end in spans]
    given = [
        replace(walk, beside=(*walk.beside, (name, replace(one, fixes=one.fixes[own])))) if len(own) else walk
        for walk, own in zip(walks, during, strict=True)
    ]
    left = np.setdiff1d(np.arange(len(time)), np.concatenate([np.empty(0, int), *during]))
    before = np.searchsorted(spans[:, 0], time[left])
    stretches = np.split(left, np.flatnonzero(np.diff(before)) + 1)
    return given, [(name, _stretch(one, rows)) for rows in stretches if len(rows) >= FEWEST]


def _stretch(one: Observation, rows: np.ndarray) -> Observation:
    """Some of a recording's positions as one of its own."""
    fixes = one.fixes[rows]
    begin, end = float(fixes.time[0]), float(fixes.time[-1])
    shifted = replace(fixes, time=fixes.time - begin)
    return replace(one, epoch=one.epoch + begin, duration=end - begin, fixes=shifted)
