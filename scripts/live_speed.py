"""How long the live navigator takes for a step, and how much memory, for docs/performance.md.

CPU is of all threads of the process; ask for one of them (OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1), as walkers' phones
have others to do.
"""

import gc
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tables import table

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from synthetic_walks import held_by_walls, live_events, walk

from pdr_graph import FloorPlan
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import events_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Steps

LOOP = Path(__file__).resolve().parent.parent / "maps" / "loop.geojson"
LAG = 60.0  # [s]
DAY = 172_800  # steps in 24 hours
SHARES = (0.1, 0.5, 1.0)  # of the walk, where the memory is looked at
PERCENTILES = {"median": 50.0, "95 %": 95.0, "99 %": 99.0, "99.9 %": 99.9, "longest": 100.0}
OF_A_LAP = [[1.25, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75]]  # corners of the middle line of maps/loop
LAPS = 38  # about an hour
OF_A_DAY = "24 h between walls, fix every 30 steps, lag 60 s"
OF_SAMPLES = "from samples at 100 Hz, between walls, fix every 15 s, lag 60 s"
PERIOD, FIRST_FIXES = 0.5, 5  # of a step [s]; number of fixes of which walkers of a crowd miss some
HANDED_OUT = 100  # steps after which settled rows are taken away
CROWD, CROWD_TIME, MINUTE = 20, 300.0, 60.0  # walkers at once; [s] how long they walk, of which the first is a row
PARTS = "push", "pose", "review"
SPUN = 2e-3  # [s] of CPU time, of a loop that does nothing: what the machine adds on the wall


@dataclass
class Run:
    """A walk that was pushed; reviews in idle moments are not counted.

    took: per step, CPU and wall time of the pushes since the one before and of its pose ``(n, 4)`` [s]; memory:
    resident at SHARES of the walk [MB]; nav: as it was before the end.
    """

    nav: Navigator
    took: np.ndarray
    memory: list[float]

    def rows(self, name, which=slice(None)):
        """Of some steps: what a push and a pose take, and both."""
        took = self.took[which]
        parts = {
            "push, CPU": took[:, 0],
            "pose, CPU": took[:, 2],
            "both, CPU": took[:, 0] + took[:, 2],
            "both, wall": took[:, 1] + took[:, 3],
        }
        return [[name, len(took), *spread(part, seconds)] for part, seconds in parts.items()]

    def state(self, name):
        """What it has in memory, and how long it takes to make the graph anew."""
        graph = self.nav._graph.graph
        marginal = sum(len(marginal.symbol) for marginal in graph.marginals)
        status = self.nav.status
        began = time.process_time()
        graph.restart(graph.lag)
        graph.solve()
        anew = time.process_time() - began
        memory = [f"{m:.0f}" for m in self.memory]
        events = f"{status.restarts} / {len(status.rebuilds)}"
        return [name, *memory, status.keyframes, marginal, events, f"{1e3 * anew:.1f}"]


def live_rows():
    """Latency, beside a loop that does nothing; memory; the first and the last hour of a day."""
    before, runs = spun(), walks()
    rows = [row for name, run in runs.items() for row in run.rows(name)]
    rows += runs[OF_A_DAY].rows("of the 24 h, the first hour", slice(DAY // 24))
    rows += runs[OF_A_DAY].rows("of the 24 h, the last hour", slice(-DAY // 24, None))
    latency = table(["walk", "steps", "per step [ms]", *PERCENTILES], rows)
    loop = [spread("before", before), spread("after", spun())]
    control = table([f"a loop of {1e3 * SPUN:.0f} ms CPU, on the wall [ms]", *PERCENTILES], loop)
    header = [
        "walk",
        *(f"MB at {share:.0%}" for share in SHARES),
        "keyframes",
        "variables of the marginal",
        "restarts / rebuilds",
    ]
    header += ["the search anew [ms]"]
    memory = table(header, [run.state(name) for name, run in runs.items()])
    hour = runs[OF_SAMPLES]
    busy = hour.took[:, [0, 2]].sum() / hour.nav.pose.time
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    said = f"The walk from samples kept one core busy for {100 * busy:.1f} % of its time. OMP_NUM_THREADS: {threads}."
    return f"{latency}\n\n{control}\n\n{memory}\n\n{crowd_rows()}\n\n{said}"


def crowd_rows():
    """Many walkers in turn, step by step: cores that they keep busy in the first minute and after it, and memory."""
    steps, fixes = held_by_walls(int(CROWD_TIME / PERIOD), period=PERIOD)
    plan, before = FloorPlan.load(LOOP), resident()
    walkers = [(Navigator(plan, lag=LAG), live_events(steps, fixes[n % FIRST_FIXES :])) for n in range(CROWD)]
    took = np.zeros((2, len(PARTS)))  # [s] in the first minute and after it
    for n in range(len(steps)):
        for nav, events in walkers:
            moments = [time.process_time()]
            push_step(nav, events)
            moments.append(time.process_time())
            nav.pose  # noqa: B018
            moments.append(time.process_time())
            nav.review()
            moments.append(time.process_time())
            took[int(n * PERIOD >= MINUTE)] += np.diff(moments)
    each, rows = f"{(resident() - before) / CROWD:.1f}", []
    spans = {"the first minute": MINUTE, "after it": CROWD_TIME - MINUTE}
    for (when, seconds), busy in zip(spans.items(), took, strict=True):
        rows.append([CROWD, when, *(f"{v / seconds:.2f}" for v in (*busy, busy.sum())), each])
    header = ["walkers of steps and fixes, between walls", "when", *(f"{part}, cores" for part in PARTS)]
    header += ["all, cores", "MB each"]
    return table(header, rows)


def push_step(nav, events):
    """Push the events up to the next step of a walker, if there is one."""
    for event in events:
        nav.push(event)
        if isinstance(event, Steps):
            return


def walks():
    """The walks, pushed, by what they are."""
    day = pushed(Navigator(FloorPlan.load(LOOP), lag=LAG), live_events(*held_by_walls(DAY, period=PERIOD)), DAY)
    return {
        OF_A_DAY: day,
        "no walls, fixes at 1 Hz, lag 60 s": pushed(Navigator(lag=LAG), live_events(*walk(20_000, 2)), 20_000),
        "no walls, fix every 30 steps, all open": pushed(Navigator(lag=None), live_events(*walk(10_000, 30)), 10_000),
        OF_SAMPLES: sampled_hour(),
    }


def spread(name, seconds):
    """A name, and PERCENTILES of some seconds [ms]."""
    return [name, *(f"{1e3 * v:.2f}" for v in np.percentile(seconds, list(PERCENTILES.values())))]


def spun(times=2000):
    """Time on the wall of SPUN of CPU time, often [s]."""
    took = []
    for _ in range(times):
        cpu, wall = clocks()
        while time.process_time() < cpu + SPUN:
            pass
        took.append(time.perf_counter() - wall)
    return took


def pushed(nav, events, steps):
    """Events pushed, the pose asked for at each step; the settled rows are taken away now and then. steps: about."""
    took, since = np.full((2 * steps, 4), np.nan), np.zeros(2)  # all there at once: its memory is not the navigator's
    count, most, memory = 0, nav.steps, []
    looks = [int(share * steps) for share in SHARES[:-1]]
    gc.collect()
    gc.freeze()  # as `replay` and `serve` do; otherwise a full garbage collection takes 30 ms of some step
    for event in events:
        before = clocks()
        nav.push(event)
        since += clocks() - before
        nav.review()  # an idle moment
        if nav.steps <= most:  # more than ever: the last ones may have been taken back
            continue
        most, before = nav.steps, clocks()
        nav.pose  # noqa: B018
        took[count] = np.append(since, clocks() - before)
        count, since = count + 1, np.zeros(2)
        if count % HANDED_OUT == 0:
            nav.finalized()
        if looks and count >= looks[0]:
            memory.append(resident())
            del looks[0]
    return Run(nav, took[:count], [*memory, resident()])


def clocks():
    """CPU time of this process and time on the wall [s]."""
    return np.array([time.process_time(), time.perf_counter()])


def resident():
    """Memory of this process now [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def sampled_hour():
    """An hour in the loop, as the phone's samples."""
    laps = [{"to": [*OF_A_LAP[1:], OF_A_LAP[0]]} for _ in range(LAPS)]
    given = {"plan": str(LOOP), "route": [OF_A_LAP[0], {"stand": 5}, *laps], "fixes": {"period": 15.0, "sigma": 3.0}}
    scenario = Scenario.of(given)
    simulated = simulate(scenario)
    recording = replace(simulated.recording(), fixes=simulated.user_fixes, epoch=scenario.start)
    nav = Navigator(FloorPlan.load(LOOP), lag=LAG, epoch=recording.epoch)
    return pushed(nav, events_of(recording), len(simulated.body.landings))
