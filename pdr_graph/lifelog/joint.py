"""A lifelog's days in one graph: the walks of a building or a group, bound by places seen again and by encounters.

The days are built already, each by itself. What was observed of all of them is read again and estimated together; so
this costs as much as the whole history, and is done when it is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pdr_graph.lifelog import files, observing
from pdr_graph.lifelog.rows import rows_of
from pdr_graph.lifelog.store import TOGETHER, Built, Store
from pdr_graph.lifelog.together import PersonDay, reconstruct_together


def bind(store: Path) -> int:
    """Put all walks of a lifelog that places or encounters bind into one graph; how many days have such walks now.

    Nothing is done where nothing has changed since the last time. Raises InputError if the lifelog cannot be used, or
    something that was observed is not there.
    """
    with Store(store.resolve()) as log:
        built, phones = log.days(), log.phones()
        key = files.key_of([[*own, day.key] for own, day in built.items()], sorted(phones.items()))
        if log.setting(TOGETHER) == key:
            return 0
        keys = {entry.hash: entry.observation for entry in log.entries()}
        days = [_day(log.folder, built, keys, *own) for own in built]
        made = reconstruct_together(days, phones)
        for day in made:
            own = built[day.person, day.date]
            log.take(rows_of(day, own.key, own.recordings))
        log.set(TOGETHER, key)
    return len(made)


def _day(
    folder: Path, days: Mapping[tuple[str, str], Built], keys: Mapping[str, str], person: str, date: str
) -> PersonDay:
    """What a day was made of. keys: by recording, of what was observed of it."""
    recordings = [(name, keys[name]) for name in days[person, date].recordings]
    observations = observing.observations_in(folder, recordings)
    before = [day.profile for (who, when), day in days.items() if who == person and when < date]
    known = [profile for profile in before if profile is not None]
    return PersonDay(person, date, observations, known[-1] if known else None)
