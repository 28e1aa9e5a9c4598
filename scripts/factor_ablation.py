"""What each factor is worth, for docs/factors.md: ``python scripts/factor_ablation.py [NAME …] [--write]``.

The same real walks with a factor and without it; the three figures are always CE50, CE75 and CE95 [m].
"""

import sys
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import gtsam
import lifelog_chains
import numpy as np
from gtsam.symbol_shorthand import X
from map_matching import HEADING, LOOP, SIGMA_HEADING, errors, known_start, walked
from microsoft import graph_of, microsoft_walks
from outliers import scattered
from recorded import WAYPOINT_NOISE, fixes_as_track, gaps, ipin2023_walks, percentiles
from reproduce import DATA
from tables import publish, table

from pdr_graph import FloorPlan, Headings, Prior, WalkGraph, smooth
from pdr_graph.apps.lifelog import reconstruct
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.factors import base as loss_functions
from pdr_graph.estimation.factors import fixes as fix_factors
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.estimation.smoother import poses_of_rows
from pdr_graph.gait.step_chunks import append_steps, gap
from pdr_graph.geometry import row_times
from pdr_graph.priors import FIXES, LOSSES, MOTION, changed
from pdr_graph.types import Closures, Trajectory

SECOND, BOTH, FIRST = "every second waypoint", "first and last", "first only"
FIRMLY = 1e-3  # of the usual sigmas: a calibration that is not estimated
NO_WIDTH = 1e6  # [σ] of a loss that never sets in
WILD = 0.2  # share of wild fixes
HOLE = 20.0  # [s]
LAPS = 2


@cache
def malls(given):
    """Microsoft's walks with that help."""
    return dict(microsoft_walks(DATA))[given]


@cache
def museum():
    """Three walks by the phone's GNSS."""
    return list(ipin2023_walks(DATA))


def said(pairs, noise=WAYPOINT_NOISE):
    """Percentiles of the errors, and the coverage of the 90 % region, of tracks with their truth."""
    errors = np.concatenate([circular_error(pair(track, truth)) for track, truth in pairs])
    if any(track.covariance is None for track, _ in pairs):
        return percentiles(errors)
    inside = np.concatenate([gaps(track, truth, noise)[1] for track, truth in pairs])
    return f"{percentiles(errors)} m, {100 * inside.mean():.0f} % in the 90 % region"


def scored(walks, **more):
    """Of walks as the graph has them."""
    return said([(smooth(graph_of(walk, **more)).trajectory, walk.truth) for walk in walks])


def with_plan(walks, **prior):
    """The same with the floor plan."""
    tracks = [smooth(graph_of(walk, floor=walk.floor, prior=Prior(**prior))).trajectory for walk in walks]
    return said([(track, walk.truth) for track, walk in zip(tracks, walks, strict=True)])


def pdr():
    walks = malls(SECOND)
    lines = said([(fixes_as_track(walk.fixes), walk.truth) for walk in walks])
    return f"with every second waypoint of fifteen mall walks given, straight lines between them are {lines} m off" + (
        f" at the others; with the steps {scored(walks)}."
    )


def sub_steps():
    jumps = []
    for walk in malls(SECOND):
        best = solutions(graph_of(walk))[0]
        jumps.append(np.hypot(*best.at.step_residual.value[:, :2].T))
    jumps = np.concatenate(jumps)
    half, most = np.percentile(jumps, [50, 95])
    return (
        f"composed from the keyframe before alone, the track of the mall walks would jump by {half:.2f} m at half"
        + (f" of the keyframes, and by {most:.2f} m and more at every twentieth (every second waypoint given).")
    )


def wall():
    walks = malls(BOTH)
    return f"mall walks with both ends given: {scored(walks)}; with walls {with_plan(walks)}."


def direction():
    """By what is given of mall walks with their plan; turns as well, in networks that are derived from the polygons."""
    rows = []
    for given in (FIRST, BOTH, SECOND):
        for name, corridors in (("walls", ()), ("and directions", ("directions",)), ("and turns", ("turns",))):
            of = with_plan(malls(given), corridors=corridors)
            rows.append([given, name, *of.replace(" in the 90 % region", "").split(" m, ")])
    header = ["given", "factors of the plan", "CE50 / CE75 / CE95 [m]", "in the 90 % region"]
    return f"mall walks with the plan:\n\n{table(header, rows)}"


def turn():
    """Laps of the paper's loop, matched along the walk between its walls."""
    free, walled = ({of: laps(of, walls) for of in ((), ("directions",), ("turns",))} for walls in (False, True))
    without, between = (
        f"{of[()]:.2f} m; with directions {of['directions',]:.2f} m, with turns {of['turns',]:.2f} m"
        for of in (free, walled)
    )
    begin = f"mean error of {LAPS} laps of a corridor loop from a known start"
    return f"{begin}, the walls left out: {without}. With the walls: {between}."


@cache
def laps(corridors, walls):
    """Mean error [m] of laps from a known start; walls: False to remove them from the optimum."""
    plan, found = FloorPlan.load(LOOP), []
    for steps, truth in map(walked, range(LAPS)):
        there = Headings(np.array([steps.start]), np.array([HEADING]), np.array([SIGMA_HEADING]))
        graph = WalkGraph(steps, known_start(steps), headings=there, floor=plan, prior=Prior(corridors=corridors))
        best = solutions(graph)[0]
        if not walls:
            best = optimize(best.graph.without(best.graph.walls), best.state)
        rows = poses_of_rows(best)
        track = Trajectory(row_times(steps), rows[:, :2], rows[:, 2], ("",) * len(rows))
        found.append(errors(track, truth).mean())
    return np.mean(found)


def losses():
    walks, random = malls(SECOND), np.random.default_rng(0)
    walks = [replace(walk, fixes=scattered(walk.fixes, WILD, random)[0]) for walk in walks]
    robust = scored(walks)
    with (
        changed(LOSSES, huber=NO_WIDTH),
        patch.object(loss_functions, "huber_weight", lambda deviation, _=NO_WIDTH: np.ones_like(deviation)),
        changed(FIXES, outlier=NO_WIDTH),
        patch.object(fix_factors, "consistent_chains", all_believed),
    ):
        gaussian = scored(walks)
    return f"one in five of the given waypoints moved by 50 to 500 m: {gaussian}; with both losses {robust}."


def all_believed(steps, fixes, sigma, used, share=None):
    """No doubt about any fix."""
    return np.where(used, 0, -1), used


def receiver():
    walks = museum()
    alone = [replace(walk, fixes=replace(walk.fixes, source=("",) * len(walk.fixes))) for walk in walks]
    one_by_one, shared = (said(tracks(of), 0.0) for of in (alone, walks))
    return f"three museum walks by the phone's GNSS, each epoch taken for independent: {one_by_one}; shared: {shared}."


def tracks(walks, levels=False):
    """Of the museum's walks, with their truth."""
    found = [smooth(graph_of(walk, levels=walk.levels if levels else None)).trajectory for walk in walks]
    return [(track, walk.truth) for track, walk in zip(found, walks, strict=True)]


def beacon():
    walks = museum()
    return f"the same walks by GNSS alone: {said(tracks(walks), 0.0)}; with the museum's beacons" + (
        f" {said(tracks(walks, levels=True), 0.0)}."
    )


def heading():
    walks = malls(FIRST)
    blind = said([(smooth(WalkGraph(walk.steps, walk.fixes)).trajectory, walk.truth) for walk in walks])
    return f"mall walks with the first waypoint alone and no plan: {blind}; with headings {scored(walks)}."


def calibration():
    walks, usual = malls(BOTH), Prior()
    fixed = Prior(sigma=tuple(FIRMLY * s for s in usual.sigma), change=tuple(FIRMLY * s for s in usual.change))
    return f"mall walks with both ends given, c = (1, 1, 0): {scored(walks, prior=fixed)}; estimated {scored(walks)}."


def chained(beside):
    """The three chains of recordings with the plan, given their ends."""
    return said(
        [(walk.estimate.trajectory, truth) for _, of, walk, truth in lifelog_chains.as_one(DATA) if of == beside]
    )


def closure():
    tied = chained("plan, field")
    with patch.object(reconstruct, "restart_closures", lambda parts: Closures.of([])):
        free = chained("plan, field")
    return f"twelve mall recordings as three walks, their six ends and the plan given: {free}; with closures {tied}."


def gap_row():
    walks = [walk for walk in malls(SECOND) if walk.steps.end - walk.steps.start > 2 * HOLE]
    stuck = [holed(walk, speed=FIRMLY, sigma_turn=MOTION.standing_turn) for walk in walks]
    torn, lost = scored(stuck), scored([holed(walk) for walk in walks])
    return (
        f"{len(walks)} mall walks with twenty seconds cut out of the middle, as if the walker had stood: {torn}; with"
        + (f" the gap {lost} (every second waypoint given).")
    )


def holed(walk, **how):
    """A walk whose recorder did not run for a while."""
    steps, begin = walk.steps, (walk.steps.start + walk.steps.end - HOLE) / 2
    first, then = steps.time <= begin, steps.time - steps.duration >= begin + HOLE
    whole = append_steps(part(steps, first, steps.start, begin), gap(begin, begin + HOLE, **how))
    return replace(walk, steps=append_steps(whole, part(steps, then, begin + HOLE, steps.end)))


def part(steps, rows, start, end):
    """Some of the steps."""
    names = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    return replace(steps, start=start, end=end, **{name: getattr(steps, name)[rows] for name in names})


def first_heading():
    """What GTSAM says of a graph without it."""
    walk = malls(FIRST)[0]
    whole = WalkGraph(walk.steps, walk.fixes)
    bare, factors = gtsam.NonlinearFactorGraph(), whole.to_gtsam()
    for n in range(factors.size()):
        if not isinstance(factors.at(n), gtsam.PoseRotationPrior2D):
            bare.add(factors.at(n))
    try:
        gtsam.Marginals(bare, whole.start.to_values()).marginalCovariance(X(0))
    except RuntimeError as error:
        found = str(error).strip().splitlines()[0]
        return f"of a walk with one fix GTSAM says: *{found}…*"
    raise SystemExit("the graph is determined without it")


WORTH = {
    "pdr": pdr,
    "sub-steps": sub_steps,
    "gap": gap_row,
    "wall": wall,
    "direction": direction,
    "turn": turn,
    "losses": losses,
    "receiver": receiver,
    "beacon": beacon,
    "heading": heading,
    "calibration": calibration,
    "first-heading": first_heading,
    "closure": closure,
}

if __name__ == "__main__":
    for name in [n for n in sys.argv[1:] if n in WORTH] or WORTH:
        publish("factors.md", f"without {name}", f"*Without it:* {WORTH[name]()}")
