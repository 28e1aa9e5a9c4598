"""Recordings observed by a worker: from their files to a file that tells what each of them told."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pdr_graph.errors import InputError, one_line
from pdr_graph.lifelog import files
from pdr_graph.lifelog.codec import decode, encode
from pdr_graph.lifelog.content import content_hash

if TYPE_CHECKING:
    from pdr_graph.lifelog.observation import Observation

LATEST = 7_258_118_400.0  # [s] Unix time of the year 2200: a clock beyond that, or before 1970, was never set
Observe = Callable[..., "Observation"]  # as of observation.observe


@dataclass(frozen=True)
class Sought:
    """A recording to be observed. hash: of its content; key, file: of the observation; made_by: what version makes it;
    others: as of `Entry`.
    """

    hash: str
    key: str
    file: str
    path: str
    plan: str
    fixes: str
    walker: str
    floor: str
    begins: float | None
    made_by: str


@dataclass(frozen=True)
class Seen:
    """What became of it. epoch, duration [s], steps: as of `Entry`; refusal: why there is no such, "" if there is."""

    hash: str
    key: str
    epoch: float = 0.0
    duration: float = 0.0
    steps: int = 0
    refusal: str = ""


def observed(sought: Sequence[Sought], observe: Observe | None = None) -> Iterator[Seen]:
    """Observe recordings, each into its file. observe: as of `observation.observe`, which it is by default.

    Raises OSError if a file cannot be written.
    """
    for one in sought:
        found = observation_in(Path(one.file))
        if found is None:
            try:
                found = _observed(one, observe)
            except Exception as error:  # of one recording: the others go on
                where = "" if isinstance(error, InputError) else f"{one.path}: "
                yield Seen(one.hash, one.key, refusal=f"{where}{said_of(error)}")
                continue
            files.write(Path(one.file), encode(found))
        steps = 0 if found.steps is None else int((found.steps.length > 0).sum())
        yield Seen(one.hash, one.key, found.epoch, found.duration, steps)


def observation_in(file: Path) -> Observation | None:
    """What a worker wrote of a recording; None if it is not there, or damaged."""
    from pdr_graph.lifelog.observation import Observation  # it takes all of gait and floor

    return files.read(file, lambda blob: decode(Observation, blob))


def observations_in(folder: Path, recordings: Sequence[tuple[str, str]]) -> dict[str, Observation]:
    """What was observed of recordings, given by hash and key of the observation; folder: ``STORE.d``.

    Raises InputError where something is not there.
    """
    found: dict[str, Observation] = {}
    for name, key in recordings:
        file = folder / files.OBSERVATIONS / key
        one = observation_in(file)
        if one is None:
            file.unlink(missing_ok=True)  # the next build has it made anew
            raise InputError(file, "", "no observation, or a damaged one", "one, or the recording that it was made of")
        found[name] = one
    return found


def said_of(error: Exception) -> str:
    """An error on one line."""
    return str(error) if isinstance(error, InputError) else one_line(f"{type(error).__name__}: {error}")


def _observed(sought: Sought, observe: Observe | None) -> Observation:
    """A recording, observed, if it is still the one that was added."""
    files.check_maker(sought.made_by)
    if observe is None:
        from pdr_graph.lifelog.observation import observe
    path = Path(sought.path)
    if not path.exists():
        raise InputError(path, "", "no such file", "the recording: add it again from where it is now")
    if content_hash(path) != sought.hash:
        raise InputError(path, "", "another content", "that with which it was added: add it again")
    plan, fixes, walker = (Path(said) if said else None for said in (sought.plan, sought.fixes, sought.walker))
    found = observe(path, plan, fixes, walker, sought.begins, sought.floor)
    if not 0 <= found.epoch < LATEST:
        raise InputError(path, "time", f"{found.epoch:g} s since 1970", "--begins, when it was recorded")
    return found
