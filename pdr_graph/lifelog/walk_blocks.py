"""Blocks of walks that are estimated in one graph: bounded, however long the history of a building is.

The walks at one place, in order of time, are parted into blocks. Each block also contains the last walks of the block
before it, whose estimates are not used: they bind the block to the same radio scans, so that both agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

# Chosen by hand: a block takes seconds and less than a gigabyte
MAX_WALKS = 30
MAX_STEPS = 60_000  # in the walks of a block
CONTEXT = 10  # walks of the block before
MAX_CONTEXT_STEPS = 20_000


@dataclass(frozen=True, order=True)
class WalkPlace:
    """A walk in a history. day, outing: its numbers; start, end: Unix times [s]; steps: number of steps."""

    day: int
    outing: int
    start: float
    end: float
    steps: int


@dataclass(frozen=True)
class WalkBlock:
    """Walks to estimate in one graph. walks: in the order of the history; context: those of the block before."""

    walks: tuple[WalkPlace, ...]
    context: frozenset[WalkPlace]


def blocks(walks: Sequence[WalkPlace]) -> Iterator[WalkBlock]:
    """Part the walks at one place into blocks of at most MAX_WALKS and MAX_STEPS, with the context of each.

    Walks of the same time, whose people may meet, are in one block, unless it would have twice as many.
    """
    block, context = list[WalkPlace](), list[WalkPlace]()
    for walk in sorted(walks, key=lambda walk: (walk.start, walk)):
        if block and _is_full([*block, walk], all(other.end < walk.start for other in block)):
            yield WalkBlock(tuple(sorted([*context, *block])), frozenset(context))
            block, context = [], _last(block)
        block.append(walk)
    if len(block) + len(context) > 1:
        yield WalkBlock(tuple(sorted([*context, *block])), frozenset(context))


def _is_full(block: Sequence[WalkPlace], may_part: bool) -> bool:
    """True if a block is too large. may_part: nobody in it walked at the time of its last walk."""
    allowed = 1 if may_part else 2
    return len(block) > allowed * MAX_WALKS or sum(walk.steps for walk in block) > allowed * MAX_STEPS


def _last(block: Sequence[WalkPlace]) -> list[WalkPlace]:
    """The last walks of a block, as context of the next."""
    steps, found = 0, list[WalkPlace]()
    for walk in reversed(block[-CONTEXT:]):
        steps += walk.steps
        if found and steps > MAX_CONTEXT_STEPS:
            break
        found.append(walk)
    return found
