"""Radio maps: fixes of later walks by the scans of earlier ones, also of a walk under way; and place recognition."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest

from pdr_graph.errors import InputError
from pdr_graph.estimation import fingerprinting
from pdr_graph.estimation.fingerprinting import RadioMap, ScanCollector, Scans, revisits, scans_of
from pdr_graph.frames import Frame
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.sensors import BLUETOOTH, WIFI, Transmitter, receptions
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import SCANS, changed
from pdr_graph.types import Recording, Sightings, Trajectory, take

ROUND = [[0, 0], {"to": [[40, 0], [40, 20], [0, 20], [0, 0]]}]
BACK = [[0, 0], {"to": [[0, 20], [40, 20], [40, 0], [0, 0]]}]
ELSEWHERE = [[300, 200], {"to": [[340, 200]]}]
BEACONS = [Transmitter(f"b{n}", np.array([8.0 * n, 10.0 + 12 * (-1) ** n])) for n in range(6)]
POINTS = [
    Transmitter(f"w{n}", place, power=-35.0)
    for n, place in enumerate(np.random.default_rng(3).uniform(-20, 60, (25, 2)))
]
FAR_POINTS = [replace(t, name="far " + t.name, place=t.place + np.array([300, 200])) for t in POINTS]


def walked(route, seed, floor="1", points=(*POINTS, *FAR_POINTS)):
    """A walk's true track and what its phone heard; the walls' pattern is the same for all."""
    body = simulate(Scenario.of({"seed": seed, "route": route, "phone": {"rate": 25}})).body
    random = np.random.default_rng(seed)
    radio = [
        receptions(body, transmitters, air, random, np.random.default_rng(7))
        for transmitters, air in ((BEACONS, BLUETOOTH), (points, WIFI))
    ]
    every = slice(None, None, 10)
    track = Trajectory(body.time[every], body.position[every], body.heading[every], (floor,) * len(body.time[every]))
    return track, Recording("walk", 0.0, None, bluetooth=radio[0], wifi=radio[1])


def errors(fixes, track):
    return fixes.position - interpolate(fixes.time, track.time, track.position)


@pytest.fixture(scope="module")
def learnt():
    return RadioMap.learn([walked(ROUND, 1), walked(BACK, 2), walked(ROUND, 3)])


@pytest.fixture(scope="module")
def later():
    return [walked(route, seed) for seed, route in enumerate([ROUND, BACK] * 5, start=10)]


def test_later_walks_are_placed_within_metres(learnt, later):
    """Where the whole place is 40 m by 20 m, half of all fixes lie within 4 m, every few seconds."""
    for track, recording in later:
        fixes = learnt.fixes(recording)
        assert np.median(np.hypot(*errors(fixes, track).T)) < 4.0
        assert np.diff(fixes.time).max() < 12.0
        assert set(fixes.floor) == {"1"}


def test_sigmas_are_honest(learnt, later):
    """Over ten walks that the map does not know, two thirds of the errors per axis are within a single fix's sigma."""
    ratios = [SCANS.shared * errors(fixes, t) / fixes.sigma[:, None] for t, r in later for fixes in [learnt.fixes(r)]]
    ratios = np.concatenate(ratios)
    assert np.mean(np.abs(ratios) < 1) == pytest.approx(0.68, abs=0.12)
    assert np.mean((ratios**2).sum(axis=1) < 4.605) == pytest.approx(0.9, abs=0.08)


def test_neighbouring_fixes_are_not_overconfident(learnt, later):
    """The mean error of a walk is within the stated sigma of the mean of independent fixes."""
    means = [errors(f, t).sum(axis=0) / np.sqrt((f.sigma**2).sum()) for t, r in later for f in [learnt.fixes(r)]]
    assert np.sqrt(np.mean(np.square(means))) < 1.2


def test_an_unmapped_place_gives_no_fix(learnt):
    _, recording = walked(ELSEWHERE, 5)
    assert len(scans_of(recording)) > 10
    assert len(learnt.fixes(recording)) == 0


def test_the_errors_of_a_single_walks_map_are_learnt_from_its_neighbourhoods(later):
    """The errors of other walks stay within twice the sigma of a map of one walk."""
    alone = RadioMap.learn([walked([*ROUND, {"to": [[40, 0], [40, 20], [0, 20], [0, 0]]}], 1)])
    ratios = [SCANS.shared * errors(f, t) / f.sigma[:, None] for t, r in later for f in [alone.fixes(r)]]
    assert np.sqrt(np.mean(np.concatenate(ratios) ** 2)) < 2.0


def test_a_walk_of_the_map_is_no_more_certain_than_others(learnt, later):
    """Its scans are those of the map and fit perfectly, which must not lower the sigma."""
    map_fixes = learnt.fixes(walked(ROUND, 1)[1])
    assert map_fixes.sigma.min() >= 0.99 * min(learnt.fixes(recording).sigma.min() for _, recording in later)


def test_a_map_of_one_place_has_a_sigma_of_half_a_metre_at_least():
    track, recording = walked([[0, 0], {"stand": 60}, {"to": [[2, 0]]}], 1)
    still = replace(track, position=np.zeros_like(track.position))
    assert RadioMap.learn([(still, recording)]).fixes(recording).sigma.min() >= 0.5 * SCANS.shared


def test_a_moving_hotspot_does_little_harm(learnt, later):
    """A hotspot in the pocket of two of three walkers and of all later ones: errors grow by less than a third."""

    def with_hotspot(recording):
        wifi = recording.wifi
        time = np.arange(0.0, wifi.time[-1], 3.0)
        everywhere = Sightings(
            np.append(wifi.time, time),
            (*wifi.transmitter, *["hotspot"] * len(time)),
            np.append(wifi.rssi, np.full(len(time), -40.0)),
        )
        return replace(recording, wifi=everywhere)

    walks = [walked(ROUND, 1), walked(BACK, 2), walked(ROUND, 3)]
    spoilt = RadioMap.learn([(t, with_hotspot(r) if n else r) for n, (t, r) in enumerate(walks)])
    clean = np.concatenate([errors(learnt.fixes(r), t) for t, r in later])
    carried = np.concatenate([errors(spoilt.fixes(with_hotspot(r)), t) for t, r in later])
    assert len(carried) > 0.9 * len(clean)
    assert np.median(np.hypot(*carried.T)) < 1.3 * np.median(np.hypot(*clean.T))


def test_the_floor_is_that_of_similar_fingerprints():
    upstairs = [replace(t, name="up " + t.name) for t in POINTS]
    both = [walked(ROUND, 1), walked(BACK, 2), walked(ROUND, 3, "2", upstairs), walked(BACK, 4, "2", upstairs)]
    fixes = RadioMap.learn(both).fixes(walked(ROUND, 9, "2", upstairs)[1])
    assert np.mean([label == "2" for label in fixes.floor]) > 0.9


def test_uncertain_parts_of_a_walk_are_not_mapped():
    track, recording = walked(ROUND, 1)
    covariance = np.zeros((len(track), 3, 3))
    covariance[track.time > 60, 0, 0] = 5.0**2
    learnt = RadioMap.learn([(replace(track, covariance=covariance), recording), walked(BACK, 2)])
    everything = RadioMap.learn([(track, recording), walked(BACK, 2)])
    scans = scans_of(recording).time
    assert len(everything) - len(learnt) == np.sum((scans > 60.5) & (scans <= track.time[-1]))


def test_cached_or_unknown_levels_are_not_used():
    time, names = np.arange(-10.0, 10.0, 0.5), ("a", "b", "c", "d") * 10
    early = Recording("walk", 0.0, None, wifi=Sightings(time, names, np.full(40, -60.0)))
    assert scans_of(early).time[0] >= -1.0
    assert scans_of(replace(early, wifi=None)).time.size == 0
    unknown = replace(early, wifi=Sightings(time, names, np.full(40, 127.0)))
    assert len(scans_of(unknown)) == 0


def test_a_map_is_read_as_it_was_written(learnt, later, tmp_path):
    learnt.save(tmp_path / "map")
    again = RadioMap.load(tmp_path / "map")
    assert again.frame == Frame().describe()
    for _, recording in later[:2]:
        first, second = learnt.fixes(recording), again.fixes(recording)
        assert first.time.tolist() == second.time.tolist()
        assert second.position == pytest.approx(first.position, abs=1e-3)
        assert second.sigma == pytest.approx(first.sigma, rel=1e-4)


def test_walks_that_are_added_make_the_map_of_all(tmp_path):
    """Also after it was written and read; a map of another frame is refused."""
    walks = [walked(ROUND, 1), walked(BACK, 2), walked(ROUND, 3)]
    RadioMap.learn(walks[:1]).save(tmp_path / "map")
    added, together = RadioMap.learn(walks[1:], known=RadioMap.load(tmp_path / "map")), RadioMap.learn(walks)
    assert added.transmitter == together.transmitter
    assert added.recording.tolist() == together.recording.tolist()
    for name in ("level", "position", "time", "range", "variance"):
        assert getattr(added, name) == pytest.approx(getattr(together, name), rel=1e-3)
    with pytest.raises(ValueError, match="found the frame"):
        RadioMap.learn(walks[1:], Frame().describe() | {"origin": [1.0, 2.0]}, together)


def test_a_map_of_many_walks_is_as_large_as_its_area_and_forgets_what_is_gone():
    """The first walk received an access point that was removed after it: it is left where nobody has walked since."""
    removed = replace(POINTS[0], name="removed", place=np.array([20.0, 10.0]))
    learnt, sizes = RadioMap.learn([walked(ROUND, 1, points=(*POINTS, removed))]), list[int]()
    assert "removed" in learnt.transmitter
    walks = [walked(ROUND, seed) for seed in range(2, 8)]
    for _ in range(8):
        learnt = RadioMap.learn(walks, known=learnt)
        sizes.append(len(learnt))
    still = learnt.level[:, learnt.transmitter.index("removed")] if "removed" in learnt.transmitter else np.zeros(1)
    assert np.mean(still > 0) < 0.05
    assert sizes[-1] < 1.05 * sizes[-2]
    places = np.unique(np.floor(learnt.position / fingerprinting.PLACE), axis=0, return_counts=True)[1]
    assert places.max() == fingerprinting.MOST_AT_PLACE


def test_a_map_of_another_version_is_refused(learnt, tmp_path):
    learnt.save(tmp_path / "map.npz")
    with_array(tmp_path / "map.npz", "version", lambda _: np.array(1))
    with pytest.raises(InputError, match="version: found 1, expected 2"):
        RadioMap.load(tmp_path / "map.npz")


def flipped_bits(whole, count=60):
    random = np.random.default_rng(0)
    for place in random.integers(0, len(whole), count):
        yield whole[:place] + bytes([whole[place] ^ 1 << random.integers(8)]) + whole[place + 1 :]


def test_a_damaged_map_is_an_input_error_or_the_same_map(learnt, tmp_path):
    """Cut off, of another kind, or with a bit changed."""
    path = tmp_path / "map.npz"
    learnt.save(path)
    whole, refusals = path.read_bytes(), []
    for content in (b"", b"time,x,y\n1,2,3\n", whole[: len(whole) // 2], whole[:-30], *flipped_bits(whole)):
        path.write_bytes(content)
        try:
            radio_map = RadioMap.load(path)
        except InputError as refusal:
            refusals.append(str(refusal))
        else:
            assert radio_map.level == pytest.approx(learnt.level, rel=1e-6)
    assert len(refusals) > 50
    assert all(str(path) in line and "\n" not in line for line in refusals)


def with_array(path, name, change):
    """Put another array, allowed to be of objects, in the place of one of a map."""
    arrays = dict(np.load(path))
    np.savez(path, **arrays | {name: change(arrays[name])})


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("level", lambda level: level[:, 1:]),
        ("level", lambda level: -level),
        ("position", lambda position: position * np.nan),
        ("range", lambda limits: limits.astype(str)),
        ("transmitter", lambda names: np.arange(len(names))),
        ("floor", lambda floor: floor[1:]),
    ],
)
def test_arrays_of_inconsistent_shapes_are_input_errors(name, wrong, learnt, tmp_path):
    path = tmp_path / "map.npz"
    learnt.save(path)
    with_array(path, name, wrong)
    with pytest.raises(InputError, match=f"map.npz, {name}: found"):
        RadioMap.load(path)


@pytest.mark.parametrize(
    ("shape", "size", "complaint"),
    [
        ((1_000_000, 1_000_000), 0, r"map.npz: found"),
        ((1000, 1000), 4_000_000, r"map.npz: found \d+ bytes unpacked, expected at most 3000000"),
    ],
    ids=["terabytes by its header", "gigabytes of zeros, packed"],
)
def test_a_map_that_is_too_large_is_refused_before_it_is_unpacked(
    shape, size, complaint, learnt, tmp_path, monkeypatch
):
    path = tmp_path / "map.npz"
    learnt.save(path)
    monkeypatch.setattr(fingerprinting, "LARGEST_MAP", 3_000_000)
    RadioMap.load(path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    members["level.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(size)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(InputError, match=complaint):
        RadioMap.load(path)


class Obedient:
    """A pickle that creates a file when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_a_pickle_in_a_map_is_not_run(learnt, tmp_path):
    path, proof = tmp_path / "map.npz", tmp_path / "proof"
    learnt.save(path)
    with_array(path, "frame", lambda _: np.array(Obedient(str(proof)), dtype=object))
    with pytest.raises(InputError):
        RadioMap.load(path)
    assert not proof.exists()
    np.load(path, allow_pickle=True)["frame"]
    assert proof.exists(), "the control: who allows pickles obeys it"


def test_too_few_scans_make_no_map():
    track, recording = walked(ROUND, 1)
    with pytest.raises(ValueError, match="found 0 scans"):
        RadioMap.learn([(track, replace(recording, bluetooth=None, wifi=None))])


def test_scans_that_arrive_piecemeal_give_the_fixes_of_the_whole_recording(learnt, later):
    """Every two seconds, and the last when the time has come; whoever asked is told each."""
    track, recording = later[0]
    expected, reported, blocks = learnt.fixes(recording), [], []
    collector = ScanCollector(learnt, reported.append)
    for begin in np.arange(0.0, track.time[-1] + 10.0, 2.0):
        for radio in ("bluetooth", "wifi"):
            heard = getattr(recording, radio)
            collector.collect(take(heard, (heard.time >= begin) & (heard.time < begin + 2.0)), radio)
        blocks += collector.due(begin + 2.0, None)
    assert reported == blocks
    assert len(expected) > 5
    for column in ("time", "position", "sigma"):
        assert np.concatenate([getattr(fixes, column) for fixes in blocks]) == pytest.approx(getattr(expected, column))


# Place recognition: walks that were at one place

ACCESS_POINTS = np.random.default_rng(0).uniform(0, 60, (40, 2))


def heard_along(track, seed=0):
    """Scans at every second, by path loss and 3 dB of noise."""
    distance = np.hypot(*(track.position[:, None] - ACCESS_POINTS).transpose(2, 0, 1))
    level = -40 - 25 * np.log10(distance.clip(1)) + np.random.default_rng(seed).normal(0, 3, distance.shape)
    names = tuple(f"ap{n}" for n in range(len(ACCESS_POINTS)))
    return Scans(track.time, names, np.maximum(level - SCANS.faintest - 20, 0.0))


def along(start, end, seconds=60, floor=""):
    position = np.linspace(start, end, seconds)
    heading = np.full(seconds, np.arctan2(*(np.subtract(end, start)[::-1])))
    return Trajectory(np.arange(seconds, dtype=float), position, heading, (floor,) * seconds)


def places(closures, walks):
    return [
        np.array([walks[w].position[round(t)] for w, t in zip(closures.walk[:, k], closures.time[:, k], strict=True)])
        for k in (0, 1)
    ]


def found(walks, known=None):
    return revisits([(known or track, heard_along(track, n)) for n, track in enumerate(walks)])


def test_two_walks_of_one_corridor_are_linked_at_the_same_places():
    """One there and one back: 90 % of the closures within three of their stated sigmas, and those of a few metres."""
    walks = [along((5, 5), (55, 5)), along((55, 6), (5, 6))]
    closures = found(walks)
    first, second = places(closures, walks)
    assert len(closures) >= 10
    apart = np.hypot(*(first - second).T)
    assert np.mean(apart < 3 * closures.sigma) > 0.9
    assert np.median(apart) < 5.0


def test_walks_of_different_floors_or_transmitters_and_single_ones_are_not_linked():
    assert len(found([along((5, 5), (55, 5), floor="1"), along((5, 6), (55, 6), floor="2")])) == 0
    walk = along((5, 5), (55, 5))
    scans = heard_along(walk)
    other = Scans(scans.time, tuple(name + "'" for name in scans.transmitter), scans.level)
    assert len(revisits([(walk, scans), (walk, other)])) == 0
    assert len(found([along((5, 5), (30, 5), 20)])) == len(found([])) == 0


def test_a_walk_is_linked_with_itself_only_at_later_revisits():
    """There and back within two minutes: moments a minute apart at least."""
    there, back = along((5, 5), (55, 5)), along((55, 5), (5, 5))
    track = Trajectory(np.arange(120.0), np.concatenate([there.position, back.position]), np.zeros(120), ("",) * 120)
    closures = found([track])
    assert len(closures)
    assert (closures.walk == 0).all()
    assert (np.abs(np.diff(closures.time, axis=1)) >= 60).all()


def test_correlated_links_count_as_one():
    """Twice as many closures of a stretch have the information of half of them, within a third."""
    walks, worth = [along((5, 5), (55, 5)), along((5, 6), (55, 6))], []
    for every in (1.0, 2.0):
        with changed(SCANS, scan_spacing=every):
            closures = found(walks)
            worth.append((len(closures), np.sum(closures.sigma**-2.0)))
    (many, of_many), (few, of_few) = worth
    assert many > 1.5 * few
    assert of_many == pytest.approx(of_few, rel=0.35)


def test_uncertain_walks_are_linked_with_the_default_sigma():
    """They are placed 100 m apart, so that no places are near each other."""
    walks = [along((5, 5), (55, 5)), along((5, 6), (55, 6))]
    moved = [walks[0], along((105, 106), (155, 106))]
    closures = revisits(
        [(estimate, heard_along(track, n)) for n, (estimate, track) in enumerate(zip(moved, walks, strict=True))]
    )
    first, second = places(closures, walks)
    assert len(closures)
    assert np.median(np.hypot(*(first - second).T)) < 5.0
