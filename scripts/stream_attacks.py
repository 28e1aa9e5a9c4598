"""Attacks on the live navigator: streams of events that no phone should send, and some that phones do send.

An attack is a function without arguments that returns a `Stream`. Walks are laps of maps/loop, as steps or as samples.
"""

import heapq
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from live_speed import LOOP, said_events
from synthetic_walks import held_by_walls

from pdr_graph import FloorPlan
from pdr_graph.estimation.fingerprinting import RadioMap
from pdr_graph.lab.simulation.scenario import Scenario, scenario_file
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import Event, Samples, Scan, events_of
from pdr_graph.types import Beacons, Fixes, Headings, Levels, Ranges, Recording, Sightings, Steps

MAPS = Path(__file__).resolve().parents[1] / "maps"
HOUR = 3600.0  # [s]
PERIOD = 0.5  # [s] per step
BEACONS, TRANSMITTERS = 100_000, 10_000


@dataclass(frozen=True)
class Stream:
    """Events in the order of arrival, and the options of the navigator that gets them.

    said: a part of a line of `Status.issues` that must have appeared, "" for none.
    """

    events: Iterable[Event]
    options: dict = field(default_factory=dict)
    said: str = ""


def on_plan(**options):
    """Options of a navigator on the plan of the walks."""
    return {"floor": FloorPlan.load(LOOP), **options}


def steps_and_fixes(hours):
    """Events of a walk on the plan: a step at a time, a fix every 30 steps."""
    return said_events(*held_by_walls(int(hours * HOUR / PERIOD), period=PERIOD))


def only_steps(hours):
    return (event for event in steps_and_fixes(hours) if isinstance(event, Steps))


@cache
def recording(name="arcade", rate=None, times=1):
    """A scenario as a phone records it, with its fixes. times: how often its route is walked; rate [Hz]."""
    path = scenario_file(name)
    content = tomllib.loads(path.read_text())
    start, *legs = content["route"]
    corners = [start, *(corner for leg in legs for corner in leg.get("to", ()))]
    back = {"to": corners[-2::-1]}
    content["route"] = [start, *legs, *[back, *legs] * (times - 1)]
    content["phone"] = content.get("phone", {}) | ({} if rate is None else {"rate": rate})
    simulated = simulate(Scenario.of(content, path))
    signals = {sensor: simulated.signals[sensor] for sensor in ("accelerometer", "gyroscope")}
    return Recording(name, 0.0, None, **signals, fixes=simulated.user_fixes)


def arcade():
    return {"floor": FloorPlan.load(MAPS / "arcade.geojson")}


def later(event, seconds):
    """The event as a clock tells it that is so much ahead."""
    if isinstance(event, Steps):
        return replace(event, start=event.start + seconds, end=event.end + seconds, time=event.time + seconds)
    if isinstance(event, Scan):
        return replace(event, heard=replace(event.heard, time=event.heard.time + seconds))
    return replace(event, time=event.time + seconds)


def arriving(delayed):
    """Events in the order of arrival, of pairs of an event and its delay [events]."""
    waiting = []
    for n, (event, delay) in enumerate(delayed):
        heapq.heappush(waiting, (n + delay, n, event))
        while waiting and waiting[0][0] <= n:
            yield heapq.heappop(waiting)[2]
    yield from (event for _, _, event in sorted(waiting, key=lambda row: row[:2]))


# Order and clocks


def fixes_late_by_hours():
    """Each fix up to three hours late or early."""
    random = np.random.default_rng(0)

    def events():
        for event in steps_and_fixes(8):
            is_fix = isinstance(event, Fixes)
            yield later(event, random.uniform(-3, 3) * HOUR) if is_fix and random.random() < 0.7 else event

    return Stream(events(), on_plan(), "measurements: ")


def fixes_delayed_by_hours():
    """Fixes with honest times that arrive up to three hours after them."""
    random = np.random.default_rng(0)
    delayed = ((e, random.uniform(0, 3) * 7200 if isinstance(e, Fixes) else 0) for e in steps_and_fixes(8))
    return Stream(arriving(delayed), on_plan(), "late")


def steps_out_of_order():
    """Steps of another front end: up to an hour late, and three times each."""
    random = np.random.default_rng(0)
    delayed = ((e, random.uniform(0, 7200) if random.random() < 0.1 else 0) for e in steps_and_fixes(4))
    return Stream((e for event in arriving(delayed) for e in (event, event, event)), on_plan(), "steps")


def samples_out_of_order():
    """A third of the packets have the time of another hour."""
    random = np.random.default_rng(0)
    shifts = [-2 * HOUR, -10.0, -1.0, 1.0, 10.0, 2 * HOUR, 1.7e9]

    def events():
        for event in events_of(recording(times=4)):
            yield later(event, random.choice(shifts)) if random.random() < 0.3 else event

    return Stream(events(), arcade(), "could not be used")


def clocks_that_jump():
    """The clock of all sensors jumps by up to an hour, ahead or back, every 30 s."""
    random = np.random.default_rng(0)

    def events():
        shift, next_jump = 0.0, 30.0
        for event in events_of(recording(times=4)):
            if isinstance(event, Samples) and event.time[0] > next_jump:
                shift, next_jump = random.uniform(-HOUR, HOUR), next_jump + 30.0
            yield later(event, shift)

    return Stream(events(), arcade(), "clock reset")


def ten_times():
    """Every event ten times."""
    return Stream((e for event in events_of(recording(times=2)) for e in [event] * 10), arcade(), "could not be used")


# Numbers


def beacons_of(count):
    """Beacons on a grid over the plan and far about it."""
    random = np.random.default_rng(0)
    position = random.uniform(-500, 500, (count, 2))
    names = tuple(f"b{n}" for n in range(count))
    return Beacons(names, position, np.ones(count), ("",) * count, names)


def heard(time, number, radio="bluetooth", names=None):
    """A scan of transmitters with these numbers."""
    random = np.random.default_rng(int(time))
    return Scan(
        radio,
        Sightings(np.full(len(number), time), tuple(f"b{n}" for n in number), random.uniform(-95, -60, len(number))),
    )


def with_scans(events, numbers, radio="bluetooth", every=2.0):
    """Events, with a scan of ``numbers(k)`` every so often [s]."""
    due, count = every, 0
    for event in events:
        yield event
        if isinstance(event, Steps) and event.end > due:
            yield heard(due - 0.01, numbers(count), radio)
            due, count = due + every, count + 1


def hundred_thousand_beacons():
    """All of a list of 100,000 beacons are heard, 200 a second, over and over."""
    random = np.random.default_rng(0)
    events = with_scans(steps_and_fixes(0.5), lambda _: random.integers(0, BEACONS, 400))
    return Stream(events, on_plan(beacons=beacons_of(BEACONS)))


def ten_thousand_in_a_scan():
    """Scans of 10,000 transmitters, which nobody listed but 100 of them."""
    events = with_scans(steps_and_fixes(0.5), lambda _: np.arange(TRANSMITTERS))
    return Stream(events, on_plan(beacons=beacons_of(100)))


def ten_thousand_listed_in_a_scan():
    """Scans of 10,000 transmitters, all of them listed."""
    events = with_scans(steps_and_fixes(0.1), lambda _: np.arange(TRANSMITTERS), every=10.0)
    return Stream(events, on_plan(beacons=beacons_of(TRANSMITTERS)))


def new_transmitters_for_a_radio_map():
    """Wi-Fi scans of 10,000 transmitters that are new in every scan."""
    random = np.random.default_rng(0)
    names, level = tuple(f"b{n}" for n in range(200)), random.uniform(-90, -50, (300, 200))
    frame = FloorPlan.load(LOOP).frame.describe()
    place = random.uniform(0, 40, (300, 2))
    radio_map = RadioMap(names, level, place, ("",) * 300, frame, np.array([0.3, 0.8]), np.array([4.0, 10.0]))
    events = with_scans(steps_and_fixes(0.5), lambda n: np.arange(TRANSMITTERS) + 5000 * n, "wifi")
    return Stream(events, on_plan(radio_map=radio_map))


def often(events, rate, measured):
    """Events, and ``measured(time)`` at ``rate`` [Hz]."""
    count = 0
    for event in events:
        if isinstance(event, Steps):
            while count / rate < event.end:
                yield measured(count / rate)
                count += 1
        yield event


def fixes_at_100_hz(source="", options=on_plan, hours=0.25):
    """Fixes a hundred times a second."""
    steps, fixes = held_by_walls(int(hours * HOUR / PERIOD), period=PERIOD)
    random = np.random.default_rng(0)

    def fix(time):
        place = [np.interp(time, fixes.time, axis) for axis in fixes.position.T]
        return Fixes(np.array([time]), np.array([place]) + random.normal(0, 3, 2), np.full(1, 3.0), source=(source,))

    return Stream(often(said_events(steps, Fixes.none()), 100.0, fix), options(), "fixes")


def ranges_of(random, time, anchors=20):
    """A range to one of many anchors."""
    labels, position = tuple(f"a{n}" for n in range(anchors)), np.linspace(0, 45, 2 * anchors).reshape(-1, 2)
    one, many = np.ones(1), np.ones(anchors)
    number = random.integers(0, anchors, 1)
    return Ranges(np.array([time]), number, random.uniform(3, 20, 1), 0.5 * one, labels, position, 0.1 * many)


def ranges_at_100_hz():
    """Ranges a hundred times a second, to 1000 anchors."""
    random = np.random.default_rng(0)
    events = often(only_steps(0.25), 100.0, lambda time: ranges_of(random, time, 1000))
    return Stream(events, on_plan(), "ranges")


def headings_at_100_hz():
    """Headings of another compass a hundred times a second."""
    random = np.random.default_rng(0)

    def heading(time):
        return Headings(np.array([time]), random.uniform(-3, 3, 1), np.array([0.5]))

    return Stream(often(steps_and_fixes(0.25), 100.0, heading), on_plan())


# Values


def unchecked(data, **columns):
    """A table whose columns were changed after its checks."""
    for name, value in columns.items():
        getattr(data, name)[...] = value
    return data


VALUES = [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, -1e300, 1e-300, 1e9, 1e-5]


def bad_row(random, end):
    """A measurement of any kind at ``end`` [s] with one value that is not possible, unchecked."""
    kind = random.integers(9)
    time, one, place = np.array([end]), np.ones(1), np.full((1, 2), 10.0)
    if kind < 3:
        value = random.choice(VALUES if kind == 2 else VALUES[:3] + VALUES[5:7])
        fix = Fixes(time, place, one, source=(random.choice(["", "gnss"]),))
        return unchecked(fix, **{("time", "position", "sigma")[kind]: value})
    if kind < 5:
        value = random.choice(VALUES if kind == 4 else VALUES[:3] + VALUES[5:7])
        return unchecked(Headings(time, one, one.copy()), **{("heading", "sigma")[kind - 3]: value})
    if kind == 5:
        return Levels(time, np.zeros(1, dtype=int), -60 * one, ("x",), place, np.array([random.choice(VALUES)]))
    if kind == 6:
        rssi = np.array([random.choice(VALUES[:3] + VALUES[5:7])])
        return Levels(time, np.zeros(1, dtype=int), rssi, ("x",), place, one)
    if kind == 7:
        ranges = Ranges(time, np.zeros(1, dtype=int), 5 * one, one, ("x",), place, one.copy())
        return unchecked(ranges, **{random.choice(["sigma", "position_sigma"]): random.choice(VALUES)})
    return Scan("bluetooth", Sightings(time, ("b0",), np.array([random.choice(VALUES[:3] + VALUES[5:7])])))


def absurd_values():
    """Rows of every kind with NaN, inf, 0, negative and huge values."""
    random = np.random.default_rng(0)

    def events():
        for event in steps_and_fixes(0.5):
            yield event
            if isinstance(event, Steps):
                yield bad_row(random, event.end)

    return Stream(events(), on_plan(beacons=beacons_of(10)), "could not be used")


def far_positions():
    """Every second fix lies 1e300 m, 9e7 m or 1e5 m away."""
    random = np.random.default_rng(0)

    def events():
        for event in steps_and_fixes(2):
            far = isinstance(event, Fixes) and random.random() < 0.5
            yield replace(event, position=event.position + random.choice([1e300, 9e7, -9e7, 1e5])) if far else event

    return Stream(events(), on_plan(), "fixes: ")


def absurd_steps():
    """Steps of another front end with lengths, turns and sigmas of any size."""
    random = np.random.default_rng(0)
    values = [1e300, -1e300, 1e150, 1e8, 1e-300, 1e4]

    def events():
        for event in steps_and_fixes(0.5):
            if isinstance(event, Steps) and random.random() < 0.05:
                name = random.choice(["length", "turn", "sigma_length", "sigma_turn", "pause_turn"])
                value = random.choice(values)
                event = replace(event, **{name: np.array([abs(value) if name.startswith("sigma") else value])})
            yield event

    return Stream(events(), on_plan(), "steps")


# Silence


def fixes_alone():
    """No steps for 24 hours, fixes at 1 Hz."""
    random = np.random.default_rng(0)
    fixes = (Fixes(np.array([float(t)]), random.normal(10, 3, (1, 2)), np.full(1, 3.0)) for t in range(int(24 * HOUR)))
    return Stream(fixes, on_plan(), "no steps")


def standing(hours=2.0, rate=50.0):
    """Hours at rest, samples at 50 Hz, fixes at 1 Hz, after a walk of the arcade."""
    walk = recording()
    begin, random = float(walk.accelerometer.time[-1]), np.random.default_rng(0)

    def events():
        yield from events_of(walk)
        for n in range(int(hours * HOUR)):
            time = begin + n + np.arange(1, rate + 1) / rate
            still = random.normal(0, 0.01, (len(time), 3))
            yield Samples("accelerometer", time, still + np.array([0.0, 0.0, 9.81]))
            yield Samples("gyroscope", time, 0.1 * still)
            yield Fixes(time[:1], walk.fixes.position[-1:] + random.normal(0, 3, 2), np.full(1, 3.0))

    return Stream(events(), arcade())


def no_fix_for_hours():
    """One fix at the start, then none for six hours."""
    walk = list(steps_and_fixes(0.01))
    first = next(event for event in walk if isinstance(event, Fixes))
    return Stream((e for part in ([first], only_steps(6)) for e in part), {})


def no_fix_for_hours_on_plan():
    return replace(no_fix_for_hours(), options=on_plan())


def nothing_but_steps_on_plan():
    """No position at all for six hours, on a plan."""
    return Stream(only_steps(6), on_plan())


def sensors_that_stop():
    """Each sensor stops and returns at random, for 1 s to 5 min."""
    random = np.random.default_rng(0)
    until = dict.fromkeys(("accelerometer", "gyroscope"), 0.0)

    def events():
        for event in events_of(recording(times=6)):
            if isinstance(event, Samples):
                if random.random() < 0.005:
                    until[event.sensor] = float(event.time[0]) + 10 ** random.uniform(0, 2.5)
                if event.time[0] < until[event.sensor]:
                    continue
            yield event

    return Stream(events(), arcade(), "silent for")


def at_rate(rate):
    """Samples at this rate. [Hz]"""
    return Stream(events_of(recording(rate=rate)), arcade())


def mixed_rates():
    """Each minute another rate, 5 to 400 Hz, with samples repeated or left out."""
    random = np.random.default_rng(0)

    def events():
        for event in events_of(recording(rate=400, times=2)):
            if isinstance(event, Samples):
                every = (1, 4, 20, 80)[int(event.time[0] // 60) % 4]
                kept = np.flatnonzero(random.random(len(event.time)) < 1 / every)
                event = replace(event, time=event.time[kept], values=event.values[kept])
            yield event

    return Stream(events(), arcade())


ATTACKS: dict[str, Callable[[], Stream]] = {
    "control: steps on a plan": lambda: Stream(steps_and_fixes(1), on_plan()),
    "control: samples on a plan": lambda: Stream(events_of(recording(times=4)), arcade()),
    "fixes whose clock is hours off": fixes_late_by_hours,
    "fixes hours late": fixes_delayed_by_hours,
    "steps out of order and three times": steps_out_of_order,
    "packets of another hour": samples_out_of_order,
    "clocks that jump by up to 1 h each 30 s": clocks_that_jump,
    "every event ten times": ten_times,
    "100,000 beacons heard": hundred_thousand_beacons,
    "10,000 transmitters a scan": ten_thousand_in_a_scan,
    "10,000 listed beacons a scan": ten_thousand_listed_in_a_scan,
    "10,000 new transmitters a scan, radio map": new_transmitters_for_a_radio_map,
    "fixes at 100 Hz, plan": fixes_at_100_hz,
    "fixes at 100 Hz, no plan": lambda: fixes_at_100_hz(options=dict),
    "fixes at 100 Hz of one receiver": lambda: fixes_at_100_hz("gnss", dict),
    "ranges at 100 Hz": ranges_at_100_hz,
    "headings at 100 Hz": headings_at_100_hz,
    "NaN, inf, 0 and negative values": absurd_values,
    "positions of 1e300 m": far_positions,
    "steps of 1e300 m": absurd_steps,
    "24 h of fixes without steps": fixes_alone,
    "2 h at rest": standing,
    "6 h after one fix": no_fix_for_hours,
    "6 h after one fix, plan": no_fix_for_hours_on_plan,
    "6 h without a position, plan": nothing_but_steps_on_plan,
    "sensors that stop and return": sensors_that_stop,
    "400 Hz": lambda: at_rate(400),
    "20 Hz": lambda: at_rate(20),
    "rates from 5 to 400 Hz": mixed_rates,
}
