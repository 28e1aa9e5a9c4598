"""The speed of pdr_graph beside what a user would write instead, section by section: the tables of docs/performance.md.

    scripts/benchmark [SECTION ...] [--write]

CPU is the time of all threads of a process; quote the ratios, since machines differ.
"""

import json
import re
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from tables import publish, table

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from synthetic_walks import LOOP, PERIOD, walk, walk_and_truth

from pdr_graph import WalkGraph, dead_reckon, kalman_filter, smooth
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.cache import content_hash
from pdr_graph.apps.lifelog.observation import Observation
from pdr_graph.apps.lifelog.store import Entry, Store
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.linear_system import one_thread
from pdr_graph.estimation.optimizer import CONVERGED, optimize
from pdr_graph.frames import enu
from pdr_graph.geometry import wrap_angle
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Headings, Steps

LAP = [[1.25, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75]]  # corners of the middle line of maps/loop
LAPS = 37  # about an hour
RUNS = 5
EVERY = 30  # steps between fixes


# An hour, from the file to the report

NOT_EXPORTED = ("truth.csv", "steps.csv", "events.csv", "fixes.csv", "gnss.csv")


def hour_rows():
    """CPU time of each stage of ``smooth`` on an hour at 100 Hz with a plan: the run of the median time of a few."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = [str(argument) for argument in hour(Path(folder))]
        clocked = [sys.executable, Path(__file__).with_name("clocked.py"), *arguments]
        runs = [json.loads(subprocess.run(clocked, check=True, capture_output=True).stdout) for _ in range(RUNS)]
        size = Path(arguments[1]).stat().st_size / 1e6
        command = [sys.executable, "-m", "pdr_graph", *arguments]
        quickest = min(_seconds_of_command(command) for _ in range(RUNS))
    middle = sorted(runs, key=lambda run: sum(cpu for cpu, _ in run["spent"].values()))[RUNS // 2]
    spent = middle["spent"]
    cpu, wall = np.sum(list(spent.values()), axis=0)
    of_graph = sum(own for stage, (own, _) in spent.items() if stage.startswith("graph"))
    rows = [[stage, f"{own:.2f}", f"{100 * own / cpu:.0f} %"] for stage, (own, _) in spent.items()]
    rows += [["**of which the graph**", f"**{of_graph:.2f}**", f"{100 * of_graph / cpu:.0f} %"]]
    rows += [["**the whole command**", f"**{cpu:.2f}**", "100 %"]]
    text = f"{size:.0f} MB zipped. On the wall {wall:.2f} s in that run, {quickest:.2f} s in the quickest of {RUNS}; "
    return f"{table(['stage', 'CPU [s]', 'share'], rows)}\n\n{text}at most {middle['memory']:.0f} MB of memory."


def hour(folder):
    """Write an hour's walk as Sensor Logger zips it; return the arguments of ``smooth``."""
    written, recording = folder / "written", folder / "walk.zip"
    route = [LAP[0], {"stand": 5}, *({"to": [*LAP[1:], LAP[0]]} for _ in range(LAPS))]
    given = {"plan": str(LOOP), "route": route, "fixes": {"period": 20.0, "sigma": 3.0}}
    write(simulate(Scenario.of(given)), written)
    with zipfile.ZipFile(recording, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(written.glob("*.csv")):
            if path.name not in NOT_EXPORTED:
                archive.write(path, path.name)
    return ["smooth", recording, "--map", LOOP, "--fixes", written / "fixes.csv", "--out", folder / "out"]


def _seconds_of_command(command):
    began = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - began


# Rivals, each with the steps, fixes and sigmas of the graph and the textbook's model of its kind

SEEDS, RIVAL_LENGTHS = 3, (2000, 7000)  # walks; steps
START_SIGMAS = np.array([3.0, 3.0, 0.3])  # [m, m, rad] of the first pose, for those that need to be told one
PRIOR = Prior()
HUBER = 2.45


def rival_rows():
    """Time and error of each on walks of two lengths, and as ratios of ours."""
    rows = []
    for n in RIVAL_LENGTHS:
        walks = [walk_and_truth(n, EVERY, seed) for seed in range(SEEDS)]
        ours = None
        for name, method in METHODS.items():
            if method in SLOW and n > RIVAL_LENGTHS[0]:
                continue
            took, errors = zip(*(_run(method, *one) for one in walks), strict=True)
            seconds, error = float(np.median(took)), np.concatenate(errors)
            ours = ours or seconds
            middle, most = np.percentile(error, [50, 95])
            rows.append([n, name, f"{seconds:.3f}", f"{seconds / ours:.2g}", f"{middle:.2f}", f"{most:.2f}"])
        limit = min(_seconds(banded_limit, n)[0] for _ in range(5))
        solve = "LAPACK's banded solve of such a chain, four times"
        rows.append([n, solve, f"{limit:.4f}", f"{limit / ours:.2g}", "", ""])
    return table(["steps", "method", "CPU [s]", "ratio", "median error [m]", "95 % [m]"], rows)


def _run(method, steps, fixes, truth):
    """CPU time [s] and the errors at the ends of steps ``(n,)`` [m]; the better of two runs."""
    (first, position), *again = [_seconds(method, steps, fixes) for _ in range(1 if method in SLOW else 2)]
    took = min([first, *(seconds for seconds, _ in again)])
    return took, np.hypot(*(position[: len(steps) + 1] - truth.position[: len(steps) + 1]).T)


def _seconds(function, *arguments):
    began = time.process_time()
    result = function(*arguments)
    return time.process_time() - began, result


def ours(steps, fixes):
    """The graph, with the covariance of every step."""
    return smooth(WalkGraph(steps, fixes)).trajectory.position


def our_filter(steps, fixes):
    """The causal filter of `kalman_filter`, which builds the graph to read it."""
    return kalman_filter(WalkGraph(steps, fixes)).trajectory.position


def custom_factors(steps, fixes):
    """Our model as GTSAM's tutorials write it: a Python CustomFactor per step, LevenbergMarquardtOptimizer."""
    import gtsam
    from gtsam.symbol_shorthand import C, X

    def step_error(k, length, turn):
        def error(this, values, jacobians):
            d = values.atPose2(X(k)).between(values.atPose2(X(k + 1)))
            R_s, R_d, b = values.atVector(C(k // 100))
            angle = R_d * turn + b * PERIOD
            forward = length * np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0])
            left = length * np.array([-np.sin(angle / 2), np.cos(angle / 2), 0.0])
            if jacobians is not None:
                jacobians[1] = np.eye(3, order="F")
                jacobians[1][:2, :2] = d.rotation().matrix()
                jacobians[0] = np.asfortranarray(-jacobians[1] @ d.inverse().AdjointMap())
                by_turn = R_s * left / 2 + np.array([0, 0, 1.0])
                jacobians[2] = np.asfortranarray(-np.column_stack([forward, by_turn * turn, by_turn * PERIOD]))
            return np.array([d.x(), d.y(), wrap_angle(d.theta() - angle)]) - R_s * forward

        return error

    graph, start = gtsam.NonlinearFactorGraph(), _dead_reckoned(steps)
    noise = _step_noise(steps)
    for k, (length, turn) in enumerate(zip(steps.length, steps.turn, strict=True)):
        graph.add(gtsam.CustomFactor(noise, [X(k), X(k + 1), C(k // 100)], step_error(k, length, turn)))
    for factor in _fix_factors(steps, fixes):
        graph.add(factor)
    segments = (len(steps) - 1) // 100 + 1
    believed = gtsam.noiseModel.Diagonal.Sigmas(np.array(PRIOR.sigma))
    graph.add(gtsam.PriorFactorVector(C(0), np.array(PRIOR.mean), believed))
    change = gtsam.noiseModel.Diagonal.Sigmas(np.array(PRIOR.change))
    for s in range(segments - 1):
        graph.add(gtsam.BetweenFactorVector(C(s), C(s + 1), np.zeros(3), change))
    for s in range(segments):
        start.insert(C(s), np.array(PRIOR.mean))
    return _positions(gtsam.LevenbergMarquardtOptimizer(graph, start).optimize())


def between_factors(steps, fixes):
    """The kinder tutorial: BetweenFactorPose2 per step, no Python in the loop, and no calibration to learn."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for factor in (*_between(steps), *_fix_factors(steps, fixes)):
        graph.add(factor)
    return _positions(gtsam.LevenbergMarquardtOptimizer(graph, _dead_reckoned(steps)).optimize())


def incremental(steps, fixes):
    """The same by iSAM2, an update and the newest pose per step, as its tutorials do. It is told a first pose, since
    it cannot begin without.
    """
    import gtsam
    from gtsam.symbol_shorthand import X

    isam, graph, start = gtsam.ISAM2(), gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose, sigmas = gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(START_SIGMAS)
    graph.add(gtsam.PriorFactorPose2(X(0), pose, sigmas))
    start.insert(X(0), pose)
    at = {int(k): factor for k, factor in zip(_rows(steps, fixes), _fix_factors(steps, fixes), strict=True)}
    for k, factor in enumerate(_between(steps)):
        graph.add(factor)
        if k + 1 in at:
            graph.add(at[k + 1])
        start.insert(X(k + 1), pose.compose(factor.measured()))
        isam.update(graph, start)
        pose = isam.calculateEstimatePose2(X(k + 1))
        graph.resize(0)
        start.clear()
    return _positions(isam.calculateEstimate())


def extended_filter(steps, fixes):
    """filterpy's extended Kalman filter over x, y, θ and a stride scale, then Rauch, Tung and Striebel by hand, since
    filterpy's own takes linear motion for granted. It is told a first pose.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    class Walker(ExtendedKalmanFilter):
        def predict_x(self, u=0):
            length, turn = u
            x, y, theta, scale = self.x
            along = scale * length * np.array([np.cos(theta + turn / 2), np.sin(theta + turn / 2)])
            self.x = np.array([x + along[0], y + along[1], theta + turn, scale])

    ekf = Walker(4, 2)
    ekf.x, ekf.P = np.array([0.0, 0.0, 0.0, 1.0]), np.diag(np.append(START_SIGMAS, PRIOR.sigma[0]) ** 2)
    at = dict(zip(_rows(steps, fixes).tolist(), range(len(fixes)), strict=True))
    H, change = np.eye(2, 4), PRIOR.change[0] / 10  # a hundredth of a segment's variance each step
    known, expected, motions = [(ekf.x, ekf.P)], [], []
    for k, (length, turn) in enumerate(zip(steps.length, steps.turn, strict=True)):
        _, _, theta, scale = ekf.x
        ahead = np.array([np.cos(theta + turn / 2), np.sin(theta + turn / 2)])
        aside = np.array([-ahead[1], ahead[0]])
        F, G = np.eye(4), np.zeros((4, 4))
        F[:2, 2], F[:2, 3] = scale * length * aside, length * ahead
        G[:2, 0], G[:2, 1], G[:2, 2], G[2, 2], G[3, 3] = ahead, aside, scale * length * aside / 2, 1.0, 1.0
        sigmas = np.array([steps.sigma_length[k], steps.sigma_length[k], steps.sigma_turn[k], change])
        ekf.F, ekf.Q = F, G * sigmas**2 @ G.T
        ekf.predict(u=(length, turn))
        expected.append((ekf.x.copy(), ekf.P.copy()))
        motions.append(F)
        if (fix := at.get(k + 1)) is not None:
            R = fixes.sigma[fix] ** 2 * np.eye(2)
            ekf.update(fixes.position[fix], lambda x: H, lambda x: x[:2], R=R)
        known.append((ekf.x.copy(), ekf.P.copy()))
    smoothed, spread = known[-1]
    states = [smoothed]
    for (x, P), (ahead, before), F in zip(known[-2::-1], expected[::-1], motions[::-1], strict=True):
        gain = P @ F.T @ np.linalg.inv(before)
        smoothed, spread = x + gain @ (smoothed - ahead), P + gain @ (spread - before) @ gain.T
        states.append(smoothed)
    return np.array(states[::-1])[:, :2]


def banded_limit(n):
    """LAPACK's banded Cholesky of a chain of n poses and four iterations: what no general solver can beat."""
    from scipy.linalg import solveh_banded

    band = np.zeros((6, 3 * n))
    band[0], band[1:, :] = 4.0, -0.1
    for _ in range(4):
        solveh_banded(band, np.ones(3 * n), lower=True, overwrite_ab=False, check_finite=False)


def _between(steps):
    """A BetweenFactorPose2 for each step."""
    import gtsam
    from gtsam.symbol_shorthand import X

    noise = _step_noise(steps)
    for k, (length, turn) in enumerate(zip(steps.length.tolist(), steps.turn.tolist(), strict=True)):
        move = gtsam.Pose2(length * np.cos(turn / 2), length * np.sin(turn / 2), turn)
        yield gtsam.BetweenFactorPose2(X(k), X(k + 1), move, noise)


def _fix_factors(steps, fixes):
    import gtsam
    from gtsam.symbol_shorthand import X

    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    for k, place, sigma in zip(_rows(steps, fixes).tolist(), fixes.position, fixes.sigma, strict=True):
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(2, sigma))
        yield gtsam.PoseTranslationPrior2D(X(k), place, noise)


def _step_noise(steps):
    import gtsam

    sigmas = np.array([steps.sigma_length[0], steps.sigma_length[0], steps.sigma_turn[0]])
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas)


def _rows(steps, fixes):
    """The pose that each fix is of: at the end of the step in which it was taken."""
    return np.searchsorted(steps.time, fixes.time) + 1


def _dead_reckoned(steps):
    import gtsam
    from gtsam.symbol_shorthand import X

    start, track = gtsam.Values(), dead_reckon(steps)
    for k in range(len(steps) + 1):
        start.insert(X(k), gtsam.Pose2(*track.position[k], track.heading[k]))
    return start


def _positions(values):
    import gtsam

    return gtsam.utilities.extractPose2(values)[:, :2]


METHODS = {
    "**pdr_graph, with covariance**": ours,
    "pdr_graph, causal filter": our_filter,
    "GTSAM: a CustomFactor per step, LevenbergMarquardtOptimizer": custom_factors,
    "GTSAM: a BetweenFactorPose2 per step, LevenbergMarquardtOptimizer": between_factors,
    "GTSAM: iSAM2, an update per step": incremental,
    "filterpy: extended Kalman filter and RTS": extended_filter,
}
SLOW = (custom_factors, incremental)

# Engines: the batch solver, and GTSAM with the same factors from the same start

ENGINES = ((2000, EVERY), (7000, EVERY), (7000, 2))  # steps, and steps between fixes
MOST_UPDATES = 20  # of iSAM2


@one_thread
def engine_rows():
    """CPU time of an iteration, of its elimination without the factors, and of the search for the optimum."""
    rows = []
    for count, every in ENGINES:
        graph = WalkGraph(*walk(count, every))
        at, exported = graph.evaluate(graph.start), graph.to_gtsam()
        system, values = graph.normal_equations(at), graph.initial_values()
        linear = exported.linearize(values)
        ours = best_of(lambda at=at, system=system: system.assembled(at).step())
        rows.append(engine_row("elimination", count, every, ours, best_of(linear.optimize)))
        ours = best_of(lambda graph=graph, system=system: system.assembled(graph.evaluate(graph.start)).step())
        theirs = best_of(lambda exported=exported, values=values: exported.linearize(values).optimize())
        rows.append(engine_row("an iteration, Python callbacks", count, every, ours, theirs))
        if every != EVERY:
            continue  # minutes
        ours, least = best_of(lambda graph=graph: optimize(graph, graph.start)), optimize(graph, graph.start).at.cost
        for name, search in {"LevenbergMarquardtOptimizer": levenberg_marquardt, "iSAM2": isam2}.items():
            theirs, cost = _seconds(search, exported, values)
            rows.append([*engine_row(f"the search by {name}", count, every, ours, theirs), f"{cost - least:+.1f}"])
    header = ["what", "steps, fix", "batch solver [ms]", "GTSAM [ms]", "ratio", "its cost beside ours [nats]"]
    return table(header, [[*row, ""][: len(header)] for row in rows])


def engine_row(what, count, every, ours, theirs):
    """A row of the table; ours, theirs: CPU time [s]."""
    times = [f"{1000 * seconds:.3g}" for seconds in (ours, theirs)]
    return [what, f"{count}, every {every} steps", *times, f"{theirs / ours:.2g}"]


def best_of(function):
    """The least CPU time of some runs [s]."""
    return min(_seconds(function)[0] for _ in range(RUNS))


def levenberg_marquardt(graph, values):
    """The least cost that GTSAM's optimiser finds."""
    import gtsam

    return graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize())


def isam2(graph, values):
    """The cost where iSAM2 stops: all factors in one update, and updates while its estimate lowers the cost."""
    import gtsam

    isam = gtsam.ISAM2()
    isam.update(graph, values)
    cost = graph.error(isam.calculateEstimate())
    for _ in range(MOST_UPDATES):
        isam.update()
        before, cost = cost, graph.error(isam.calculateEstimate())
        if not before - cost > CONVERGED * (1 + cost):
            break
    return cost


# Scaling

SCALES = (1000, 10_000, 100_000, 1_000_000)  # steps


def scaling_rows():
    """Time of building and solving with the covariance of every step, and memory beyond that of the walk itself."""
    rows = []
    for steps in SCALES:
        with alone() as process:
            took, before, memory = process.submit(scaled, steps).result()
        more = memory - before
        rows.append([f"{steps:,}".replace(",", " "), f"{took:.3f}", f"{1e6 * took / steps:.1f}", f"{more:.0f}"])
        rows[-1] += [f"{1e3 * more / steps:.1f}", f"{memory:.0f}"]
    return table(["steps", "CPU [s]", "µs per step", "memory [MB]", "kB per step", "of the process [MB]"], rows)


def scaled(count):
    """Least CPU time of a few runs [s], and peak memory before and after them [MB], of a walk of some steps."""
    steps, fixes = walk(count, EVERY)
    before, took = peak_memory(), []
    while len(took) < RUNS and sum(took) < 2.0:
        took.append(_seconds(lambda: smooth(WalkGraph(steps, fixes)) and None)[0])
    return min(took), before, peak_memory()


def alone():
    """A process of its own, whose memory is that of what it does."""
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"))


def peak_memory():
    """The most memory that this program has taken [MB]; ru_maxrss would count what it was forked from."""
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024


# A lifelog, of observations that are drawn as those of a phone carried all day: steps, and fixes half of the time

FIRST = datetime(2024, 5, 1, 7, tzinfo=UTC).timestamp()  # [s] Unix time of the first walk
WALKS, APART = 3, 14_400.0  # on each day; [s] between them
OUTSIDE, FIX, SIGMA = 600.0, 30.0, 4.0  # [s] outside, and as long inside again; between fixes outside; [m] of them
MONTH, MONTH_STEPS = 30, 1_000_000  # days of one person, and steps in all of them


def lifelog_rows():
    """Time, memory and files of a month of one person, built by one process."""
    with tempfile.TemporaryDirectory() as folder, alone() as process:
        took, memory, size, again = process.submit(month, folder).result()
    rows = [[f"{MONTH} days, {MONTH_STEPS} steps, one process", f"{took:.1f} s, {memory:.0f} MB of memory"]]
    rows += [["the same again, nothing being new", f"{again:.2f} s"]]
    rows += [["the store", f"{size[0] / 1e6:.0f} MB"], ["observations beside it", f"{size[1] / 1e6:.0f} MB"]]
    return table(["a month", ""], rows)


def month(folder):
    """Time [s] and memory [MB] of a month, sizes of its files [B], and the time of building it again [s]."""
    log = lifelog(Path(folder), 1, MONTH, MONTH_STEPS / MONTH)
    _, took, memory = timed(log)
    size = [log.stat().st_size, sum(file.stat().st_size for file in log.with_name("lifelog.db.d").rglob("*"))]
    again = time.perf_counter()
    build(log, observe=drawn)
    return took, memory, size, time.perf_counter() - again


def lifelog(folder, people, days, steps):
    """A lifelog of some people, each with as many steps on each day."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    entries = []
    for person, day, number in np.ndindex(people, days, WALKS):
        file = raw / f"{person}-{day}-{number}.txt"
        file.write_text(f"{len(entries)} {day} {number} {round(steps / WALKS)}")
        entries.append(Entry(content_hash(file), f"person {person:02}", str(file)))
    with Store(folder / "lifelog.db", new=True) as log:
        log.put(*entries)
    return folder / "lifelog.db"


def timed(log, **options):
    """Days, time [s] that they take once all is observed, and most memory [MB]; ``build`` must be whole."""
    began = time.perf_counter()

    def progress(stage, done, total):
        nonlocal began
        if stage == "recordings":
            began = time.perf_counter()

    drawing = import_module(Path(__file__).stem).drawn  # by a name that is the same in every process
    result = build(log, progress=progress, observe=drawing, **options)
    took = time.perf_counter() - began
    if result.failures or result.refusals:
        raise SystemExit("\n".join([*result.failures, *result.refusals]))
    return result.built, took, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def drawn(recording, *_):
    """The observation of a recording, whose file has seed, day, number on that day, and steps."""
    seed, day, number, count = map(int, recording.read_text().split())
    random, zeros = np.random.default_rng(seed), np.zeros(count)
    time_ = 0.55 * np.arange(1, count + 1)
    length, turn = random.normal(0.7, 0.05, count), random.normal(0, 0.1, count)
    sigmas = zeros + 0.07, zeros + 0.02
    true = Steps(0.0, time_[-1] + 0.5, time_, zeros + 0.55, length, turn, zeros, *sigmas)
    at = np.flatnonzero(np.diff(time_ // FIX, prepend=0) * (time_ % (2 * OUTSIDE) < OUTSIDE))
    place = dead_reckon(true).position[at + 1] + random.normal(0, SIGMA, (len(at), 2))
    length, turn = 0.95 * length + random.normal(0, 0.07, count), turn + random.normal(0, 0.02, count)
    return Observation(
        source=recording.stem,
        epoch=FIRST + 86_400.0 * day + APART * number,
        duration=true.end,
        frame=enu(52.5, 13.4),
        plan="",
        floor="",
        steps=replace(true, length=length, turn=turn),
        looks=np.zeros(count + 1),
        headings=Headings.none(),
        fixes=Fixes(time_[at], place, np.full(len(at), SIGMA), ("",) * len(at), source=("GNSS",) * len(at)),
    )


if __name__ == "__main__":
    sections = {
        "hour": hour_rows,
        "rivals": rival_rows,
        "engines": engine_rows,
        "scaling": scaling_rows,
        "lifelog": lifelog_rows,
    }
    chosen = [a for a in sys.argv[1:] if a != "--write"]
    if not set(chosen) <= set(sections):
        raise SystemExit(f"usage: scripts/benchmark [{' | '.join(sections)}] [--write]")
    for name in chosen or sections:
        publish("performance.md", name, sections[name]())
