"""Ways outdoors: read from files, found along a walk, and as factors. `krems.osm` is a cut of a real town.

© OpenStreetMap contributors, Open Database License 1.0.
"""

import gzip
import json
import sys
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import plans
import pytest
import shapely
import walks
from commands import run
from derivatives import assert_derivatives
from synthetic_walks import live_events
from tiers import thorough

from pdr_graph import Fixes, InputError, Navigator, PathNetwork, WalkGraph, smooth
from pdr_graph.estimation.factors.base import decisions_of
from pdr_graph.floor.building import Building
from pdr_graph.floor.paths import POINTS_EVERY, _Lattice, match
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import interpolate
from pdr_graph.lab.papers.hmm_map_matching import hmm_match
from pdr_graph.lab.simulation import town_walks
from pdr_graph.priors import WAYS

KREMS = Path(__file__).parent.parent / "floor" / "krems.osm"
FRAME = enu(48.409, 15.599)
NEAR = Fixes(np.array([0.0, 60.0]), np.array([[-200.0, -200.0], [200.0, 200.0]]), np.full(2, 5.0))
TOWN = PathNetwork.load(KREMS, FRAME, NEAR)


def walked(network, seed, **changes):
    """A walk along ways, and its fixes."""
    walk = town_walks.town_walk(network, seed, **changes)
    return walk, town_walks.fixes_of(walk, seed)


def mean_error(estimate, walk, where=None):
    track = estimate.trajectory
    off = np.hypot(*(interpolate(walk.time, track.time, track.position) - walk.place).T)
    return off[slice(None) if where is None else where].mean()


def lines_in(network):
    return sorted(
        (name, tuple(np.round(line, 2).ravel())) for name, line in zip(network.classes, network.lines, strict=True)
    )


def test_every_reader_finds_the_same_ways(tmp_path, monkeypatch):
    packed = tmp_path / "krems.osm.gz"
    packed.write_bytes(gzip.compress(KREMS.read_bytes()))
    features = [
        {
            "type": "Feature",
            "properties": {"highway": name},
            "geometry": {"type": "LineString", "coordinates": FRAME.to_lonlat(line).tolist()},
        }
        for name, line in zip(TOWN.classes, TOWN.lines, strict=True)
    ]
    drawn = tmp_path / "krems.geojson"
    drawn.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    assert len(TOWN) > 50
    for path in (packed, drawn):
        assert lines_in(PathNetwork.load(path, FRAME, NEAR)) == lines_in(TOWN)
    monkeypatch.setitem(sys.modules, "osmium", None)  # not installed
    for path in (KREMS, packed):
        assert lines_in(PathNetwork.load(path, FRAME, NEAR)) == lines_in(TOWN)


def test_a_gpx_route_is_a_way(tmp_path):
    places = "".join(f'<rtept lat="{48.409 + 1e-3 * n}" lon="15.599"/>' for n in range(3))
    (route := tmp_path / "r.gpx").write_text(f'<gpx version="1.1"><rte>{places}</rte></gpx>')
    network = PathNetwork.load(route, FRAME, NEAR)
    assert [len(line) for line in network.lines] == [3]
    np.testing.assert_allclose(network.lines[0][2], [0, 222.4], atol=0.2)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cut.osm", KREMS.read_bytes()[:20_000], "damaged extract"),
        ("x.osm.pbf", b"\0\0\0\x0d\n\tOSMHeader\x18", "damaged extract"),
        ("entity.osm", b'<!DOCTYPE osm [<!ENTITY a "b">]><osm><node id="1"/></osm>', "entities"),
        ("picture.png", b"\x89PNG\r\n", "another format"),
        ("none.geojson", b'{"type": "FeatureCollection", "features": []}', "no way on foot"),
    ],
)
def test_what_has_no_ways_is_refused(tmp_path, name, content, said):
    (path := tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        PathNetwork.load(path, FRAME, NEAR)


def test_another_town_is_refused_with_the_distance():
    vienna = enu(48.208, 16.373)
    with pytest.raises(InputError, match=r"nearest of \d+ ways is 61\.\d km away"):
        PathNetwork.load(KREMS, vienna, NEAR)


def small_lattices():
    """Lattices of which all sequences of states can be tried, with the cost of each sequence."""
    random = np.random.default_rng(0)
    s, p = 4, 3
    source, to = np.array(list(product(range(p), repeat=2))).T
    for _ in range(20):
        lattice = _Lattice(
            place=random.normal(0, 6, (p, 2)),
            emission=random.uniform(0, 2, (s, p)),
            source=source,
            to=to,
            far=random.uniform(0, 2, p * p),
            track=random.normal(0, 4, (s, 2)),
            stray=np.full(s, 5.0),
            longest=np.full(s - 1, 1.5),
            sigma=np.full(s - 1, 3.0),
        )

        def cost(states, along=0.0, entered=0.0, lattice=lattice):
            """along, entered: additional cost of a move along ways, and of the first point on them."""
            total = sum(WAYS.off if j == p else lattice.emission[t, j] for t, j in enumerate(states))
            total += entered * (states[0] != p)
            for t, (i, j) in enumerate(pairwise(states)):
                if p in (i, j):
                    total += WAYS.leave * (i != j) + entered * (i == p != j)
                else:
                    off = lattice.place[j] - lattice.place[i] - (lattice.track[t + 1] - lattice.track[t])
                    total += off @ off / 18.0 + along if lattice.far[i * p + j] <= 1.5 else np.inf
            return total

        yield lattice, cost, list(product(range(p + 1), repeat=s))


def test_the_path_is_the_best_of_all():
    """On a small lattice every path is tried."""
    for lattice, cost, every in small_lattices():
        best, found = lattice.path()
        assert found == pytest.approx(min(cost(states) for states in every))
        assert cost(np.where(best < 0, len(lattice.place), best).tolist()) == pytest.approx(found)


def test_probabilities_are_those_of_all_paths():
    length = np.sqrt(2 * np.pi) / POINTS_EVERY
    for lattice, cost, every in small_lattices():
        weight = np.exp([-cost(states, np.log(3.0 * length), np.log(5.0 * length)) for states in every])
        shares = [np.bincount(of_station, weight) / weight.sum() for of_station in np.transpose(every)]
        np.testing.assert_allclose(lattice.probability(), shares, atol=1e-12)


def test_parallel_ways_are_in_the_region():
    """Two streets 24 m apart, the walk between them: the place of the other street is in the region."""
    lines = tuple(np.array([(0.0, y), (400.0, y)]) for y in (0.0, 24.0))
    network, track = PathNetwork(lines, ("residential",) * 2), np.array([(x, 11.0) for x in np.arange(0.0, 400.0, 2.0)])
    n = len(track)
    way = match(network, track, np.full(n, 12.0), np.full(n, 0.02))
    assert way.on.all()
    probability, mean = way.others[:, 0], way.others[:, 2]
    assert (np.abs(probability - 0.4) < 0.2).all()
    np.testing.assert_allclose(mean, 13.0 * probability, atol=1.0)  # some of it is off every way, where the walk is
    sure = match(PathNetwork(lines[:1], ("residential",)), track, np.full(n, 12.0), np.full(n, 0.02))
    assert sure.others[:, 0].max() < 0.1


def test_a_walk_is_matched_to_the_ways_that_it_follows():
    walk, _ = walked(TOWN, 3, length=600)
    moved = walk.place + np.array([6.0, -5.0])
    way = match(TOWN, moved, np.full(len(moved), 6.0), np.full(len(moved), 0.05))
    back = np.median(way.displacement[way.on], axis=0)
    assert way.on.mean() > 0.9
    np.testing.assert_allclose(back, [-6.0, 5.0], atol=3.0)  # ways are 3 to 10 m wide


def test_a_gap_in_a_walk_joins_no_ways():
    """The walk jumps by kilometres, as after a ride; either part is matched by itself."""
    walk, _ = walked(TOWN, 3, length=400)
    jumped = np.concatenate([walk.place, walk.place[::-1] + np.array([0.0, 9000.0]), walk.place])
    sigma = np.full(len(jumped), 4.0)
    way = match(TOWN, jumped, sigma, sigma / 100)
    first, away, last = np.split(way.on, 3)
    assert first.mean() > 0.9
    assert not away.any()
    assert np.array_equal(first, last)


def test_derivatives_of_the_factors():
    walk, fixes = walked(TOWN, 1, length=250)
    graph = smooth(WalkGraph(walk.steps, fixes, paths=TOWN)).graph
    assert len(graph.evaluate(graph.start).blocks_of("paths.direction"))
    assert_derivatives(graph, graph.start)


def test_a_receiver_that_is_off_is_recognised_by_ways():
    walk, fixes = walked(TOWN, 5, length=1000)
    off = replace(fixes, position=fixes.position + np.array([8.0, -7.0]))
    for given, most, said in ((fixes, 5.0, False), (off, 6.0, True)):
        estimate = smooth(WalkGraph(walk.steps, given, paths=TOWN))
        assert mean_error(estimate, walk) < most
        assert any(found.against == "paths" for found in estimate.contradictions) == said
    assert mean_error(smooth(WalkGraph(walk.steps, off)), walk) > 9.0, "without ways"


@pytest.mark.thorough
def test_a_live_walk_follows_ways_where_a_receiver_is_off():
    """The ways come in a frame of their own, those of a whole extract; no more than a minute is in the window.

    That shows the offset in one of three walks only (docs/results/paths.md).
    """
    walk, fixes = walked(TOWN, 1, length=900)
    off = replace(fixes, position=fixes.position + np.array([8.0, -7.0]))
    extract, errors = PathNetwork.load(KREMS), []
    for ways in (None, extract):
        nav = Navigator(frame=FRAME, paths=ways, executor=None)
        for event in live_events(walk.steps, off):
            nav.push(event)
        errors.append(mean_error(nav.finish(), walk))
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize("frame", [enu(48.208, 16.373), thorough(Frame())], ids=["Vienna", "a plan without latitude"])
def test_ways_of_another_town_bend_no_live_walk(frame):
    walk, fixes = walked(TOWN, 1, length=150)
    nav = Navigator(frame=frame, paths=PathNetwork.load(KREMS), executor=None)
    for event in live_events(walk.steps, fixes):
        nav.push(event)
    estimate = nav.finish()
    assert mean_error(estimate, walk) < 7.0
    assert not any(found.against == "paths" for found in estimate.contradictions)


def test_the_window_has_the_distances_of_the_batch():
    """The same factor at the same keyframes: decisions carry the ways, without the directions of runs."""
    walk, fixes = walked(TOWN, 1, length=500)
    graph = smooth(WalkGraph(walk.steps, fixes, paths=TOWN)).graph
    batch = graph.ways
    window = batch.about(TOWN).continued(decisions_of(batch)).bind(graph.chain)
    at = graph.evaluate(graph.start)
    [distances, _], [again, directions] = batch.factors(at), window.factors(at)
    np.testing.assert_array_equal(again.residual, distances.residual)
    assert not len(directions)
    half = window.bind(graph.chain.after(len(graph.chain.segment) // 2))
    assert 0 < len(half) < len(window)


def beside_a_street():
    """A building with one door, and ways outdoors."""
    building = plans.plan(
        ("corridor", shapely.box(0, 0, 60, 3)),
        ("room", shapely.box(0, 3, 60, 10)),
        ("door", shapely.box(-0.4, 0.9, 0.1, 2.1)),
    )
    lines = [[(-12, -100), (-12, 60)], [(-12, -5), (80, -5)], [(-12, 6), (80, 6)]]
    return building, PathNetwork(tuple(np.array(line, float) for line in lines), ("path",) * 3)


def steps_along(*corners):
    """Steps of 0.7 m along corners, and the place of each, the start first."""
    corners = np.array(corners)
    walked = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    place = np.stack([np.interp(np.arange(0, walked[-1], 0.7), walked, axis) for axis in corners.T], axis=1)
    move = np.diff(place, axis=0)
    heading = np.arctan2(move[:, 1], move[:, 0])
    return walks.steps_of(np.hypot(*move.T), np.diff(heading, prepend=heading[0])), place


@pytest.mark.thorough
@pytest.mark.parametrize("along_ways", [False, True])
def test_a_live_walk_leaves_the_building(along_ways):
    """Its pose is no longer kept on the plan, and with ways the walls say nothing of it."""
    building, network = beside_a_street()
    steps, place = steps_along((30.0, 1.5), (-12.0, 1.5), (-12.0, -50.0))
    rows = np.arange(2, len(steps), 4)
    position = place[rows + 1] + np.random.default_rng(0).normal(0, 1, (len(rows), 2))
    fixes = Fixes(steps.time[rows], position, np.full(len(rows), 1.5), ("",) * len(rows), source=("GPS",) * len(rows))
    nav = Navigator(floor=building, paths=network if along_ways else None, executor=None)
    for event in live_events(steps, fixes):
        nav.push(event)
    assert np.hypot(*(place[-1] - (nav.pose.x, nav.pose.y))) < 15, "on the plan it is 50 m"
    said = str(nav.status.verdict)
    assert "leads through walls" not in said if along_ways else said.startswith("doubtful")


def test_ways_end_at_the_doors_of_a_plan():
    """A street leads past a building, a path along its wall, another through it; the walk goes in by the door."""
    building, network = beside_a_street()
    joined = network.joined(Building.around(building))
    assert joined.joined(Building.around(building)) is joined
    assert [line[0].round(1).tolist() for line in joined.lines[-1:]] == [[-0.2, 1.5]], "from the door"
    assert not any(shapely.LineString(line).crosses(shapely.box(0, 0, 60, 10)) for line in joined.lines)
    assert joined.lines[-1][1].tolist() in joined.lines[0].tolist(), "a corner of the street"

    steps, place = steps_along((-12.0, -90.0), (-12.0, 1.5), (57.0, 1.5))
    rows = np.flatnonzero(place[1:, 0] < 0)[::4]  # none indoors
    position = place[rows + 1] + np.random.default_rng(0).normal(0, 2, (len(rows), 2))
    fixes = Fixes(steps.time[rows], position, np.full(len(rows), 5.0), ("",) * len(rows), source=("GPS",) * len(rows))
    estimate = smooth(WalkGraph(steps, fixes, floor=building, paths=network))
    assert estimate.graph.walled
    assert not estimate.contradictions, "neither the plan nor the walk outdoors is doubted"
    ways, pose = estimate.graph.ways, estimate.graph.optimum.poses
    inside = pose[:, 0] > 2
    assert inside.sum() > 5
    assert not inside[ways.followed].any(), "the plan rules there"
    assert len(ways) > 0.8 * np.count_nonzero(pose[:, 1] < -8)
    assert ((pose[inside, 1] > 0) & (pose[inside, 1] < 10)).all()


def test_a_missing_way_bends_nothing():
    """The walk crosses a lawn: its error there is that without ways."""
    errors = []
    for seed in range(3):
        walk, fixes = walked(TOWN, seed, length=900, across=True)
        for ways in (None, town_walks.lawn(TOWN, walk)):
            errors.append(mean_error(smooth(WalkGraph(walk.steps, fixes, paths=ways)), walk, ~walk.on))
    without, with_ways = np.reshape(errors, (-1, 2)).mean(axis=0)
    assert with_ways < 1.05 * without + 0.3


def test_the_baseline_follows_its_model():
    """Fixes without errors in the middle of ways are matched to within the points' spacing."""
    walk, fixes = walked(TOWN, 2, length=600)
    points = TOWN.points.place
    nearest = np.argmin(np.hypot(*(walk.at(fixes.time)[:, None] - points).transpose(2, 0, 1)), axis=1)
    exact = replace(fixes, position=points[nearest])
    off = np.hypot(*(hmm_match(TOWN, exact, exact.time) - exact.position).T)
    assert np.median(off) < POINTS_EVERY
    assert np.percentile(off, 95) < 3 * POINTS_EVERY


def test_from_the_command_line(tmp_path):
    fixes = tmp_path / "track.gpx"
    _, given = walked(TOWN, 1, length=300)
    points = "".join(
        f'<trkpt lat="{lat:.7f}" lon="{lon:.7f}"><time>2024-05-01T10:0{t // 60:.0f}:{t % 60:02.0f}Z</time></trkpt>'
        for (lon, lat), t in zip(FRAME.to_lonlat(given.position).tolist(), given.time.tolist(), strict=True)
    )
    fixes.write_text(f'<gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    code, _, errors = run("smooth", fixes, "--paths", KREMS, "--no-report", "--out", tmp_path / "out")
    assert (code, errors) == (0, [])
    code, out, _ = run("map", "show", KREMS, "--paths", "--out", tmp_path / "town.png")
    assert code == 0
    assert "ways" in out
    assert (tmp_path / "town.png").read_bytes().startswith(b"\x89PNG")
