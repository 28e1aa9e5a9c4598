"""Pieces of one walk as one walk, and all walks of a floor in one graph: for docs/results/lifelog.md."""

from dataclasses import replace

import numpy as np
from recorded import WAYPOINT_NOISE, gaps, given, rest
from tables import publish, table

from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.reconstruct import estimate_walk
from pdr_graph.apps.lifelog.sessions import Session
from pdr_graph.apps.lifelog.store import RecordingOptions
from pdr_graph.estimation.fingerprinting import revisits, scans_of
from pdr_graph.estimation.multi_walk import smooth_together
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes, Trajectory

CHAINS = ("site1/B1", "site1/F1", "site2/F1")
NO_PIECE = "5dda0214"  # of site1/F1, an hour later: no piece of its chain


def observed(folder):
    """Every walk of a floor, in order of time, with its waypoints."""
    found = [(observe(path, RecordingOptions(plan=folder)), load(path)) for path in sorted(folder.glob("*.txt"))]
    return sorted(found, key=lambda pair: pair[0].epoch)


def scores(pairs):
    """Errors in percentiles and how often a place lies in its 90 % region, of tracks with their truth."""
    found = [gaps(track, truth, WAYPOINT_NOISE) for track, truth in pairs]
    errors, inside = (np.concatenate([one[k] for one in found]) for k in (0, 1))
    return [*(f"{p:.2f}" for p in np.percentile(errors, [50, 75, 95])), f"{100 * inside.mean():.0f} %"]


def whole_truth(pieces):
    """The waypoints of all pieces, from the start of the first."""
    first = pieces[0][0].epoch
    time = np.concatenate([walk.truth.time + one.epoch - first for one, walk in pieces])
    return Trajectory(
        time, np.concatenate([walk.truth.position for _, walk in pieces]), np.zeros(len(time)), ("",) * len(time)
    )


def by_ends(pieces, plan):
    """The pieces with the first waypoint of the first and the last one of the last."""
    ones = [replace(one, fixes=Fixes.none(), plan=one.plan if plan else "") for one, _ in pieces]
    ones[0] = replace(ones[0], fixes=given(pieces[0][1].truth, [0]))
    end = given(pieces[-1][1].truth, [-1])
    both = Fixes.concatenate([ones[-1].fixes, end])
    ones[-1] = replace(ones[-1], fixes=both)
    return Session(tuple((str(n), one) for n, one in enumerate(ones)))


def aware(group):
    """As it is: the magnetic field says how far the walker turned between two recordings."""
    return group


def unaware(group):
    """The same, were nothing known of the time between two recordings."""
    return Session(tuple((name, replace(one, ends=None, epoch=one.epoch)) for name, one in group.parts))


def as_one(data):
    """Each chain as one walk, by what is given beside its two ends: its name, that, the walk, and the waypoints that
    were not given.
    """
    for name in CHAINS:
        pieces = [pair for pair in observed(data / "ms_indoor20" / name) if NO_PIECE not in pair[1].source]
        truth = whole_truth(pieces)
        length = np.hypot(*np.diff(truth.position, axis=0).T).sum()
        said = f"{name}, {len(pieces)} recordings, {length:.0f} m"
        for beside, plan, of in (("field", False, aware), ("plan", True, unaware), ("plan, field", True, aware)):
            yield said, beside, estimate_walk(of(by_ends(pieces, plan)), None, None), rest(truth, [0, -1])


def chains(data):
    """The three chains, each as one walk."""
    rows, pooled = [], {}
    for name, beside, walk, truth in as_one(data):
        pair = walk.estimate.trajectory, truth
        pooled.setdefault(beside, []).append(pair)
        rows.append([name, beside, *scores([pair])])
    rows += [["all three", beside, *scores(pairs)] for beside, pairs in pooled.items()]
    return table(["chain", "beside its two ends", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region"], rows)


def together(data):
    """All recordings of a floor, one by one and in one graph."""
    rows = []
    floors = [observed(data / "ms_indoor20" / name) for name in CHAINS[:2]]
    for said, which in (("first waypoint", [0]), ("first and last", [0, -1])):
        for plan in (False, True):
            alone, joint = [], []
            for walks in floors:
                ones = [
                    replace(one, fixes=given(walk.truth, which), plan=one.plan if plan else "") for one, walk in walks
                ]
                found = [estimate_walk(Session((("", one),)), None, None) for one in ones]
                scans = [scans_of(walk) for _, walk in walks]
                estimates = [walk.estimate for walk in found]
                closures = revisits([(e.trajectory, s) for e, s in zip(estimates, scans, strict=True)])
                both = smooth_together([walk.graph for walk in found], estimates, closures)
                truths = [rest(walk.truth, which) for _, walk in walks]
                alone += [(e.trajectory, t) for e, t in zip(estimates, truths, strict=True)]
                joint += [(e.trajectory, t) for e, t in zip(both, truths, strict=True)]
            for how, pairs in (("one by one", alone), ("in one graph", joint)):
                rows.append([said, "with the plan" if plan else "", how, *scores(pairs)])
    return table(["given of each", "", "", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region"], rows)


def lifelog_chains(data):
    """Both tables."""
    publish("results/lifelog.md", "lifelog-chains", chains(data))
    publish("results/lifelog.md", "lifelog-together", together(data))
