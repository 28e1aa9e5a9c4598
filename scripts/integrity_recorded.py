"""Real recordings with their real lists of beacons, for the table of integrity."""

from dataclasses import replace

from integrity_scores import HEADER, cells, score
from microsoft import microsoft_walks
from recorded import WAYPOINT_NOISE, ipin21_walks, ipin2023_walks, nju_walks
from tables import publish, table

from pdr_graph import WalkGraph, smooth

PUBLISHED, RIGHT, WRONG = "the published list", "the list put right", "another pair swapped as well"
SWAPS = {PUBLISHED: [], RIGHT: [("BLE2", "BLE3")], WRONG: [("BLE2", "BLE3"), ("BLE1", "BLE4")]}  # of the published one


def recorded(data):
    """The table; of logs that have GNSS, harm is that of the beacons."""
    rows = [*malls(data), *museum(data), *eight(data)]
    for walk in nju_walks(data):
        rows.append(["NJU campus", walk.name, *cells([scored(walk)], None)])
    publish("results/integrity.md", "integrity recorded", table(["recordings", "given", *HEADER], rows))


def scored(walk, plan=False, noise=0.0):
    """The score of a walk, with its plan or without."""
    graph = WalkGraph(
        walk.steps, walk.fixes, headings=walk.headings, levels=walk.levels, floor=walk.floor if plan else None
    )
    return score(smooth(graph), walk.truth, noise)


def malls(data):
    """Microsoft's fifteen walks by what is given."""
    for given, walks in microsoft_walks(data):
        without = [scored(walk, noise=WAYPOINT_NOISE) for walk in walks]
        yield ["Microsoft", given, *cells(without, None)]
        yield ["Microsoft", f"{given}, plan", *cells([scored(walk, True, WAYPOINT_NOISE) for walk in walks], without)]


def museum(data):
    """IPIN 2023, log by log and all together: GNSS alone, and with each list."""
    alone = [(walk.name, scored(replace(walk, levels=None))) for walk in ipin2023_walks(data)]
    lists = {
        name: [scored(walk) for walk in ipin2023_walks(data, lambda listed, swaps=swaps: swapped(listed, swaps))]
        for name, swaps in SWAPS.items()
    }
    for n, (name, one) in enumerate(alone):
        short = f"IPIN 2023, {name.split('Training')[1].split('_')[0]}"
        yield [short, "GNSS", *cells([one], None)]
        for given, scores in lists.items():
            yield [short, f"GNSS, beacons: {given}", *cells([scores[n]], [one])]
    everything = [one for _, one in alone]
    yield ["IPIN 2023, all", "GNSS", *cells(everything, None)]
    for given, scores in lists.items():
        yield ["IPIN 2023, all", f"GNSS, beacons: {given}", *cells(scores, everything)]


def swapped(listed, pairs):
    """A list with some pairs exchanged. pairs: of labels."""
    position, floor = listed.position.copy(), list(listed.floor)
    for pair in pairs:
        one, other = (listed.label.index(label) for label in pair)
        position[[one, other]] = position[[other, one]]
        floor[one], floor[other] = floor[other], floor[one]
    return replace(listed, position=position, floor=tuple(floor))


def eight(data):
    """IPIN21's figure of eight with each set of simulated fixes."""
    for walk in ipin21_walks(data):
        without = [scored(walk)]
        yield ["IPIN21's eight", walk.name, *cells(without, None)]
        yield ["IPIN21's eight", f"{walk.name}, plan", *cells([scored(walk, True)], without)]
