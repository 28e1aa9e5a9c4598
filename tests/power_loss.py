"""Power cuts: files of a journal, a lifelog and a live session, damaged as a disk that lost power leaves them.

A `Target` has the files of a folder at several moments and a function that opens a damaged folder and says what came
back. ``scripts/fuzz.py stores`` counts thousands of cuts, ``test_power_cuts.py`` some.
"""

import asyncio
import json
import random
import shutil
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE / "online"), str(HERE / "lifelog")]

# ruff: noqa: E402
import days_standin
import numpy as np
from simulated import walk_along
from standin import StandIn, event

from pdr_graph import InputError
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.diary import digest_of
from pdr_graph.apps.lifelog.facts import AT, Correction, Guess
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.store import ZONE, Store
from pdr_graph.apps.serve.live_walk import LOG, PUBLISHED, SESSION, LiveWalk, MessageLog, Session, write_session
from pdr_graph.apps.serve.publishing import Hub
from pdr_graph.apps.serve.reception import Reception, blank_pose
from pdr_graph.lab.simulation.streaming import batches, message
from pdr_graph.online.journal import Journal, read_entries
from pdr_graph.types import Recording, Signal

WHOLE = "whole"  # nothing is missing
STATED = "loss said"  # what came back is an earlier whole state or a part, and the loss was said
UNNOTICED = "loss unnoticed"  # an earlier state, and nothing left to know it by
CHANGED = "value changed"  # a number or a text that decodes has another value, and nothing says so
REFUSED = "refused"  # in one line, and the files are unchanged
FAILED = "FAILED"
OUTCOMES = (WHOLE, STATED, UNNOTICED, CHANGED, REFUSED, FAILED)
PAGE = 4096  # bytes that a disk writes at once
Files = dict[str, bytes]  # content by path in the folder


@dataclass(frozen=True)
class Target:
    """What is damaged. ages: the files at earlier moments, the last one now; damaged: names, one of which is damaged.

    reopen: opens a damaged folder; returns an outcome and what was found. It raises InputError to refuse.
    """

    ages: list[Files]
    damaged: tuple[str, ...]
    reopen: Callable[[Path], tuple[str, str]]


def cut(content, chance, _):
    """The end is missing."""
    most = len(content) if chance.random() < 0.5 else min(len(content), 600)
    return content[: len(content) - chance.randint(1, most)]


def flip(content, chance, _):
    """Some bytes have another value."""
    flipped = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 8))):
        flipped[chance.randrange(len(flipped))] ^= chance.randint(1, 255)
    return bytes(flipped)


def tail(content, chance, _):
    """The last pages were never written: they are zeros."""
    pages = chance.randint(1, 3) * min(PAGE, max(1, len(content) // 4))
    return content[: max(0, len(content) - pages)] + bytes(min(pages, len(content)))


def old(_, chance, ages):
    """As it was at an earlier moment, which may be before there was one (None)."""
    return chance.choice(ages)


DAMAGES = {"cut": cut, "flip": flip, "tail": tail, "old": old}


def names(target):
    """The files that are there now and may be damaged."""
    return [name for name in target.ages[-1] if any(Path(name).match(pattern) for pattern in target.damaged)]


def attack(target, damage, seed, folder):
    """Damage a file of a new copy of the folder and open it; returns the outcome and what was found."""
    chance = random.Random(seed)
    shutil.rmtree(folder, ignore_errors=True)
    put(folder, target.ages[-1])
    name = chance.choice(names(target))
    content = target.ages[-1][name]
    after = DAMAGES[damage](content, chance, [age.get(name) for age in target.ages[:-1]])
    if after == content:
        return WHOLE, "unchanged"
    if after is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(after)
    if chance.random() < 0.3:  # left by another program that read the file
        shared = folder / f"{next(iter(target.ages[-1]))}-shm"
        if not shared.exists():
            shared.write_bytes(chance.randbytes(32768))
    before = {path: each for path, each in taken(folder).items() if not path.endswith("-shm")}
    try:
        outcome, found = target.reopen(folder)
    except InputError as refusal:
        outcome, found = REFUSED, on_one_line(refusal)
        if any(taken(folder).get(path) != each for path, each in before.items()):
            outcome, found = FAILED, f"refused, but files have changed: {found}"
    except Exception as error:
        outcome, found = FAILED, f"{type(error).__name__}: {error}"
    return outcome, f"{name}: {found}"


def on_one_line(error):
    """The text of an error, which must be one line."""
    text = str(error)
    is_line = len(text) < 1000 and text.isprintable()
    assert is_line, f"not a line: {text[:500]!r}"
    return text


def count(target, damage, number, folder, say=lambda line: None):
    """Outcomes of some attacks, by kind; say: called with each failure."""
    outcomes = Counter()
    for n in range(number):
        outcome, found = attack(target, damage, f"{damage}{n}", folder)
        outcomes[outcome] += 1
        if outcome == FAILED:
            say(f"{damage} {n}: {found}")
    return outcomes


def put(folder, files):
    """Write files into a folder."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def taken(folder):
    """The files of a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


# ── the journal of a walk ───────────────────────────────────────────────────────────────────────────────────────────

EVENTS = 230


def journal(path):
    return Journal.open(path, StandIn, {"lag": 60.0})


def walk_of(navigator):
    """All that a walk is, bit by bit: where it is, and each row of its trajectory."""
    track = navigator.finish().trajectory
    columns = (track.time, track.position, track.heading, track.covariance)
    rows = zip(*([row.tobytes() for row in column] for column in columns), track.floor, strict=True)
    return repr(navigator.place), list(rows)


def journal_target(folder):
    """A walk whose process ended without closing its journal."""
    states, ages = [], []
    with journal(folder / "walk") as walk:
        for number in range(EVENTS + 1):
            states.append(walk_of(walk.navigator))
            if number in (0, 20, 60, 93, 95, 142, 180, 200):
                ages.append(taken(folder))
            if number < EVENTS:
                walk.push(event(number))
        ages.append(taken(folder))

    def reopen(damaged):
        with journal(damaged / "walk") as found:
            resumed, loss = found.count, found.loss
            if walk_of(found.navigator) != states[resumed]:
                return FAILED, f"another walk after {found.count} events"
            for number in range(found.count, EVENTS):
                found.push(event(number))
            if walk_of(found.navigator) != states[EVENTS]:
                return FAILED, f"a walk that goes on otherwise after {resumed} events"
        with journal(damaged / "walk") as again:
            if walk_of(again.navigator) != states[EVENTS]:
                return FAILED, "another walk when it is opened again"
        return verdict(resumed == EVENTS and not loss, loss, f"{resumed} of {EVENTS} events")

    return Target(ages, ("walk",), reopen)


def verdict(whole, said, found):
    """The outcome of something that came back whole, or as it was earlier."""
    return (WHOLE, found) if whole else (STATED, f"{found}: {said}") if said else (UNNOTICED, found)


# ── the store of a lifelog ──────────────────────────────────────────────────────────────────────────────────────────


def lifelog_ages(folder):
    """A lifelog of five days after each of its builds, and in the middle of them; the last one is killed in a build."""
    ages = []
    (folder / "store").mkdir()
    with Store(folder / "store" / "log", new=True) as log:
        log.put_setting(ZONE, "UTC")

    def reconstruct(*inputs):
        ages.append(taken(folder / "store"))
        return days_standin.reconstruct(*inputs)

    for day in range(5):
        raw = days_standin.recording(folder / "raw" / f"{day}.plt", day, seed=day)
        add(folder / "store" / "log", [raw], copy=True)
        with Store(folder / "store" / "log") as log:
            log.put_correction(Correction(0, "me", 1.7e9, AT, 86400.0 * day, 86400.0 * day + 60, {"name": f"at {day}"}))
            log.put_guesses("me", [Guess("google", 1e9 + day, 1e9 + day + 1, "place", f"guess {day}", 52.0, 13.0, 0.5)])
            ages.append(taken(folder / "store"))
        build(folder / "store" / "log", reconstruct=reconstruct)
        with Store(folder / "store" / "log") as log:
            for person, date in log.days():
                digest_of(log, person, date, log.day_hash(person, date))
        ages.append(taken(folder / "store"))
    return ages


def lifelog_content(log):
    """Everything in a lifelog, by what it is of; without the folder in which it lies."""
    found = {("recording", entry.hash): repr(replace(entry, path="")) for entry in log.entries()}
    found |= {("correction", each.number): repr(each) + each.content for each in log.corrections()}
    found |= {("guess", each.start): repr(each) for each in log.guesses("me")}
    found |= {("setting", name): log.setting(name) for name in ("zone", "together")}
    for person, date in log.days():
        log.day(person, date)  # raises if it is damaged
        found["day", date] = log.day_hash(person, date)
    return found


def shown(store):
    """The content of a lifelog, or nothing and why it is refused, in one line."""
    try:
        with Store(store) as log:
            return lifelog_content(log), ""
    except InputError as refusal:
        return {}, on_one_line(refusal)


def store_target(folder, killed=True):
    """The database of a lifelog. killed: while a build had it open."""
    ages = lifelog_ages(folder)[: -1 if killed else None]
    states = [content_of(age, folder / "scratch") for age in ages]
    known = {name: {state[name] for state in states if name in state} for state in states for name in state}

    def reopen(damaged):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            before, refusal = shown(damaged / "log")
            if said:  # as the line says
                add(damaged / "log", sorted((folder / "raw").iterdir()), copy=True)
            result = build(damaged / "log", "UTC" if said else None, reconstruct=days_standin.reconstruct)
            after, refusal_after = shown(damaged / "log")
        wrong = [name for found in (before, after) for name in found if found[name] not in known.get(name, ())]
        lost = {name for name, value in final.items() if after.get(name) != value}
        if result.failures or refusal_after:
            return FAILED, f"failures of the next build: {result.failures} {refusal_after}"
        if wrong:
            return CHANGED, f"{wrong}"
        loss = "; ".join(str(each.message) for each in said) or refusal
        return verdict(not lost and not loss, loss, f"{len(lost)} of {len(final)} rows earlier or lost")

    final = content_of(ages[-1], folder / "scratch", build_it=True)
    known["setting", "zone"].add("")  # if it is lost, which is said
    for name, value in final.items():
        known.setdefault(name, set()).add(value)
    return Target(ages, ("log", "log-journal"), reopen)


def content_of(age, folder, build_it=False):
    """The content of a lifelog at an age; build_it: after a build."""
    shutil.rmtree(folder, ignore_errors=True)
    put(folder, age)
    if build_it:
        build(folder / "log", reconstruct=days_standin.reconstruct)
    with Store(folder / "log") as log:
        return lifelog_content(log)


def closed_store_target(folder):
    """The database of a lifelog that nobody has open."""
    return store_target(folder, killed=False)


def beside_target(folder):
    """The files beside the database: observations of recordings and digests of days."""
    ages = lifelog_ages(folder)
    final = content_of(ages[-1], folder / "scratch", build_it=True)

    def digests(store):
        with Store(store) as log:
            return [repr(digest_of(log, person, date, log.day_hash(person, date))) for person, date in log.days()]

    expected = digests(folder / "scratch" / "log")

    def reopen(damaged):
        found = digests(damaged / "log")
        with Store(damaged / "log") as log:
            log.delete_days(log.days())
        told = build(damaged / "log", reconstruct=days_standin.reconstruct).failures  # damaged observations
        result = build(damaged / "log", reconstruct=days_standin.reconstruct)
        if found != expected or result.failures or shown(damaged / "log")[0] != final:
            return FAILED, f"other days: {result.failures}"
        return verdict(not told, "".join(told), "made again")

    return Target(ages, ("log.d/observations/*", "log.d/digests/*"), reopen)


# ── a session of pdr-graph serve ────────────────────────────────────────────────────────────────────────────────────

MESSAGES, EPOCH = 12, 1_700_000_000.0


def messages():
    """Messages of a phone, a second each."""
    walk = walk_along(np.array([[0.0, 0.0], [12.0, 0.0]]), seed=3)
    signals = {"accelerometer": walk.acceleration, "gyroscope": walk.angular_rate}
    recording = Recording("walk", 0.0, EPOCH, **{name: Signal(walk.time, rows) for name, rows in signals.items()})
    return [message("session", n, payload) for n, payload in enumerate(batches(recording)[: MESSAGES + 1])]


def walker(folder):
    """The walker of a session with all its messages used."""
    session = Session("s", "s", "phone", "owner", "sensorlogger", "android", 0.0)
    walk = LiveWalk(folder, session, lambda **_: StandIn())
    while walk.work(np.inf):
        pass
    return walk


def session_target(folder):
    """A live walk whose server ended without closing its files."""
    bodies, ages, store = messages(), [], folder / "store"
    store.mkdir()
    for n, body in enumerate(bodies[:MESSAGES]):
        log = MessageLog(store / LOG)
        log.add(n, EPOCH + n, body)
        log.close()
        ages.append(taken(store))
    final = of_session(walker(store))

    def reopen(damaged):
        try:
            walk = walker(damaged)
        except InputError:
            return FAILED, "the walk is not estimated anew"
        found, said = of_session(walk), list(walk._issues())
        fresh = folder / "fresh"
        shutil.rmtree(fresh, ignore_errors=True)
        put(fresh, {LOG: (damaged / LOG).read_bytes()})
        remaining = list(read_entries(damaged / LOG))
        if found not in (final, of_session(walker(fresh))):
            return FAILED, "neither the whole walk nor that of the messages that remain"
        log = MessageLog(damaged / LOG)
        log.add(MESSAGES, EPOCH + MESSAGES, bodies[MESSAGES])
        log.close()
        if len(list(read_entries(damaged / LOG))) != len(remaining) + 1:
            return FAILED, "the log does not take another message"
        whole = found == final and len(remaining) == MESSAGES
        return verdict(whole, "; ".join(said), f"{len(remaining)} of {MESSAGES} messages")

    return Target(ages, (LOG,), reopen)


def of_session(walk):
    """`walk_of` that its navigator estimates; None without one."""
    return None if walk._navigator is None else walk_of(walk._navigator)


def published_target(folder):
    """What is known of a finished session, and shown of it."""
    session = Session("id", "key", "phone", "ann", "sensorlogger", "android", EPOCH)
    pose, ages = blank_pose(session) | {"state": "finished", "x": 1.25}, []
    root = folder / "store" / "id"
    root.mkdir(parents=True)
    for n in (1, 9):
        column = {name: [0.125 * k for k in range(n)] for name in ("time", "x", "y", "lon", "lat", "floor")}
        write_session(root, Session(**{**vars(session), "finished": n == 9}))
        published = {"pose": pose, "path": {"finalised": column, "current": column}}
        (root / PUBLISHED).write_text(json.dumps(published))
        ages.append(taken(folder / "store"))

    async def load(reception):
        reception.load()  # makes the recordings that a server's end prevented, in its loop

    def shown(damaged):
        hub, said = Hub(), []
        asyncio.run(load(Reception(damaged, hub, say=said.append)))
        walkers = {id_: (walker.user, walker.pose, walker.finalised) for id_, walker in hub.walkers.items()}
        return walkers, said + [issue for _, pose, _ in walkers.values() for issue in pose["issues"]]

    states = []
    for age in ages:
        put(folder / "store", age)
        states.append(shown(folder / "store")[0])

    def reopen(damaged):
        walkers, said = shown(damaged)
        if any((user, pose["x"]) not in (("ann", 1.25), ("ann", None)) for user, pose, _ in walkers.values()):
            return CHANGED, f"another pose or user: {walkers}"
        return verdict(walkers == states[-1], said, f"{len(walkers)} of 1 session")

    return Target(ages, (f"id/{SESSION}", f"id/{PUBLISHED}"), reopen)


TARGETS = {
    "journal": journal_target,
    "store in a build": store_target,
    "store at rest": closed_store_target,
    "files beside it": beside_target,
    "session": session_target,
    "session.json, published": published_target,
}
