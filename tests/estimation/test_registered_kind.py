"""The kind of measurement that CONTRIBUTING.md defines, registered by one call, runs through the whole package."""

import json
import sys
from dataclasses import dataclass, field, make_dataclass, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import simulated
from derivatives import assert_derivatives, assert_gtsam_agrees, random_state
from tiers import thorough
from walks import distances, drawn_from_the_model, part

import pdr_graph as pdr
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.observation import observe, read_observation
from pdr_graph.apps.lifelog.store import RecordingOptions, Store
from pdr_graph.apps.report import output_files as outputs
from pdr_graph.errors import Stages
from pdr_graph.estimation.factors.registry import KINDS
from pdr_graph.estimation.particle_filter import pose_costs
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory
from pdr_graph.priors import PARTICLES
from pdr_graph.types import repeated, take
from pdr_graph.walk import Options, estimate, read
from pdr_graph.walk import observe as evidence_of

SIGMA = 0.2  # [m]
EVERY = 3.0  # [s] between two lines


def example_of_the_page():
    """The module of the example as it is printed: a file that processes can import, which registers its kind."""
    page = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    code = page.split("## A factor")[1].split("```python\n")[1].split("```")[0]
    (Path(FOLDER.name) / "example_of_the_page.py").write_text(code, encoding="utf-8")
    sys.path.append(FOLDER.name)
    return import_module("example_of_the_page")


FOLDER = TemporaryDirectory()
EXAMPLE = example_of_the_page()
del KINDS[EXAMPLE.Anchorline]  # until its tests run
Anchorline = EXAMPLE.Anchorline


@dataclass(frozen=True)
class LineReport:
    time: float
    residual: float
    weight: float
    reason: str


class AnchorlineFactor(EXAMPLE.AnchorlineFactor):
    """With two of the optional parts."""

    determines_position = True

    def reports(self, at, which=None):
        [block] = at.blocks_of(self.name)
        off, time = block.residual * self.lines.sigma[self.keyframe >= 0], self.lines.time[self.keyframe >= 0]
        return tuple(LineReport(float(t), float(r), 1.0, "on the line") for t, r in zip(time, off, strict=True))


@pytest.fixture(autouse=True, scope="module")
def registered():
    """The one call."""
    pdr.register(Anchorline, AnchorlineFactor)
    yield
    del KINDS[Anchorline]


def lines_along(truth, seed=0):
    """A line every three seconds, across x and across y in turn, where the truth is to 0.2 m."""
    time = np.arange(truth.time[0] + 1.0, truth.time[-1] - 1.0, EVERY)
    normal = np.eye(2)[np.arange(len(time)) % 2]
    along = np.sum(interpolate(time, truth.time, truth.position) * normal, axis=1)
    noise = np.random.default_rng(seed).normal(0, SIGMA, len(time))
    return Anchorline(time, along + noise, normal, np.full(len(time), SIGMA))


def drawn(seed=0, n=100):
    """Steps, fixes, truth and lines of a walk drawn from the model."""
    steps, fixes, truth = drawn_from_the_model(n, seed, sigma_length=0.15)
    return replace(steps, end=float(steps.time[-1])), fixes, truth, lines_along(truth, seed)


def error(track, truth):
    """Median distance of a trajectory from the truth [m]."""
    return np.median(distances(truth, track))


def median_sigma(track):
    """Median standard deviation of the position per axis [m]."""
    return np.median(np.sqrt(np.trace(track.covariance[:, :2, :2], axis1=1, axis2=2) / 2))


def test_smooth_follows_the_lines_and_is_surer_with_them():
    """Fixes of 1.5 m alone are worse by far; each line is reported with its distance from the walk."""
    steps, fixes, truth, lines = drawn()
    alone = pdr.smooth(pdr.WalkGraph(steps, fixes))
    along = pdr.smooth(pdr.WalkGraph(steps, fixes, measurements=[lines]))
    assert error(along.trajectory, truth) < 0.5 * error(alone.trajectory, truth)
    assert median_sigma(along.trajectory) < 0.5 * median_sigma(alone.trajectory)
    reports = along.reports["anchor_lines"]
    assert [report.time for report in reports] == lines.time.tolist()
    assert np.median(np.abs([report.residual for report in reports])) < 2 * SIGMA


def test_lines_alone_place_a_walk():
    """They measure x and y in turn, so that no fix is needed; none lies near the walk's start at (0, 0)."""
    steps, _, truth, lines = drawn(4)
    estimate = pdr.smooth(pdr.WalkGraph(steps, measurements=[lines]))
    assert error(estimate.trajectory, truth) < 0.5
    assert not np.isnan(estimate.probability)


def test_derivatives_and_gtsams_error_are_those_of_ours():
    steps, fixes, _, lines = drawn(1, 30)
    graph = pdr.WalkGraph(steps, fixes, measurements=[lines])
    for seed in range(2):
        state = random_state(graph, np.random.default_rng(seed))
        assert "anchor_lines" in assert_derivatives(graph, state)
        assert_gtsam_agrees(graph, state)


def test_optional_parts_are_not_needed():
    """Without reports of its own a kind has whitened residuals, at the times of its keyframes."""
    steps, fixes, _, lines = drawn(5, 40)
    walks = []
    for kind in (EXAMPLE.AnchorlineFactor, AnchorlineFactor):
        del KINDS[Anchorline]
        pdr.register(Anchorline, kind)
        walks.append(pdr.smooth(pdr.WalkGraph(steps, fixes, measurements=[lines])))
    assert walks[0].trajectory.position == pytest.approx(walks[1].trajectory.position, abs=1e-9)
    usual, own = (walk.reports["anchor_lines"] for walk in walks)
    assert [report.residual * SIGMA for report in usual] == pytest.approx([report.residual for report in own])
    assert [report.time for report in usual] == pytest.approx([report.time for report in own], abs=1.0)
    assert {report.weight for report in usual} == {1.0}


def test_it_weighs_particles():
    """It has no method for particles: its residuals are enough, and only at its keyframe."""
    lines = Anchorline(np.array([0.0, 5.0, 5.0]), np.array([3.0, 4.0, -9.0]), np.eye(2)[[0, 0, 0]], np.full(3, 2.0))
    bound = AnchorlineFactor(lines, np.arange(3), keyframe=np.array([2, 7, 7]))
    state = np.random.default_rng(0).normal(0, 8, (6, 30))
    expected = sum(np.minimum(0.5 * ((state[0] - z) / 2.0) ** 2, PARTICLES.outlier_price) for z in (4.0, -9.0))
    [costs] = pose_costs([bound], 7)
    assert np.sum(list(costs.costs(state)), axis=0) == pytest.approx(expected)
    assert pose_costs([bound], 3) == ()


def events(steps, fixes, lines):
    """The steps one by one, each followed by the fixes and lines of its time."""
    done = -np.inf
    for k, end in enumerate(steps.time.tolist()):
        yield part(steps, k, k + 1)
        if (new := (lines.time > done) & (lines.time <= end)).any():
            yield Anchorline(*(column[new] for column in vars(lines).values()))
        if (new := (fixes.time > done) & (fixes.time <= end)).any():
            yield fixes[new]
        done = end


def test_a_live_walk_with_an_endless_lag_is_that_of_the_batch():
    steps, fixes, truth, lines = drawn(2)
    batch = pdr.smooth(pdr.WalkGraph(steps, fixes, measurements=[lines])).trajectory
    nav = pdr.Navigator(lag=None)
    for event in events(steps, fixes, lines):
        nav.push(event)
    live = nav.trajectory
    apart = np.hypot(*(interpolate(live.time, batch.time, batch.position) - live.position).T)
    assert np.median(apart) < 0.02, "0.5 m without the lines"
    assert len(nav.finish().reports["anchor_lines"]) == len(lines.time)
    assert error(live, truth) < 0.5


def test_rows_that_are_not_finite_are_counted_and_left_out():
    """No limits are stated for the columns of this type."""
    steps, fixes, _, lines = drawn(2, 40)
    nav = pdr.Navigator(lag=None)
    damaged = replace(lines, offset=np.where(np.arange(len(lines.time)) == 1, np.nan, lines.offset))
    for event in events(steps, fixes, damaged):
        nav.push(event)
    assert "anchor_lines: 1 could not be used" in nav.status.issues
    assert np.isfinite(nav.trajectory.position).all()
    assert len(nav.finish().reports["anchor_lines"]) == len(lines.time) - 1


def journal_of(path):
    return pdr.Journal.open(path, pdr.Navigator)


def test_a_journal_keeps_the_lines(tmp_path):
    """Opened again half-way, it goes on with the walk of one that stayed open, bit by bit."""
    arriving = list(events(*(drawn(3)[n] for n in (0, 1, 3))))
    half, tracks = len(arriving) // 2, []
    with journal_of(tmp_path / "resumed") as journal:
        for event in arriving[:half]:
            journal.push(event)
    for name, begin in (("resumed", half), ("whole", 0)):
        with journal_of(tmp_path / name) as journal:
            assert journal.count == begin
            for event in arriving[begin:]:
                journal.push(event)
            tracks.append(journal.trajectory)
    assert np.array_equal(tracks[0].position, tracks[1].position)
    assert np.array_equal(tracks[0].covariance, tracks[1].covariance)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A simulated recording with two fixes 2 m off; its truth and lines along it."""
    folder = tmp_path_factory.mktemp("lines")
    simulated.indoor_location(folder, np.array([(40.0, 30.0), (65.0, 30.0), (65.0, 42.0), (40.0, 42.0)]), seed=4)
    walk = load(folder / "walk.txt")
    truth = read_trajectory(folder / "truth.csv", walk)
    rows = [(t, *(p + 2.0), 3.0) for t, p in zip(truth.time[[20, -20]], truth.position[[20, -20]], strict=True)]
    lines = [",".join(f"{value:.3f}" for value in (row[0] + walk.clock_origin, *row[1:])) for row in rows]
    (folder / "fixes.csv").write_text("\n".join(["time,x,y,sigma", *lines]) + "\n")
    return folder, truth, lines_along(truth)


def test_report_and_summary_list_the_lines(recorded, tmp_path):
    folder, truth, lines = recorded
    evidence = read(folder / "walk.txt", Options(fixes=folder / "fixes.csv"))
    walk = replace(evidence.walk, measurements=(lines,))
    result = estimate(evidence_of(replace(evidence, walk=walk)))
    assert error(result.estimate.trajectory, truth) < 0.4
    assert outputs.write(tmp_path, result, Stages()) == ()
    assert "Anchor lines" in (tmp_path / "report.html").read_text()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert len(summary["reports"]["anchor_lines"]) == len(lines.time)
    assert summary["reports"]["anchor_lines"][0]["time"] == pytest.approx(lines.time[0] + walk.clock_origin)


@pytest.mark.parametrize("workers", [1, thorough(2)])
def test_a_lifelog_stores_the_lines_and_builds_days_with_them(recorded, tmp_path, workers):
    """What reads the lines of a recording is the caller's; the store has them from then on."""
    folder, truth, lines = recorded

    def with_lines(path, options):
        return replace(observe(path, options), measurements=(lines,))

    add(tmp_path / "log", [folder / "walk.txt"], RecordingOptions(fixes=folder / "fixes.csv"))
    assert build(tmp_path / "log", workers=workers, observe=with_lines).failures == ()
    with Store(tmp_path / "log") as log:
        [entry], [(person, date)] = log.entries(), log.days()
        [stored] = read_observation(log.folder / "observations" / entry.observation).measurements
        [outing] = log.day(person, date).outings
    assert isinstance(stored, Anchorline)
    assert np.array_equal(stored.offset, lines.offset)
    assert error(outing.trajectory, truth) < 0.4


def test_what_is_declared_of_the_whole_is_neither_selected_nor_repeated():
    """Colours as many as lines: by length alone they would be a column of rows."""
    lines = ColouredLines(np.arange(2.0), np.zeros(2), np.eye(2), np.ones(2), colours=("red", "blue"), hue=("a", "b"))
    one = take(lines, [1, 1, 0])
    assert (one.time.tolist(), one.hue, one.colours) == ([1.0, 1.0, 0.0], ("b", "b", "a"), ("red", "blue"))
    kind = Coloured(lines, np.array([5, 6]), np.array([2, 7]), walk=np.array([10.0, 20.0]))
    again = repeated(kind, np.array([1, 1, 0]), np.array([0, 1, 2]))
    assert (again.number.tolist(), again.keyframe.tolist()) == ([6, 6, 5], [0, 1, 2])
    assert (again.lines.hue, again.lines.colours) == (("b", "b", "a"), ("red", "blue"))
    assert again.walk.tolist() == [10.0, 20.0]


def test_a_column_with_another_number_of_rows_is_refused_in_one_line():
    """At once: in a batch, live, and of a kind that says of the walk what it declares of its rows."""
    steps, fixes, _, lines = drawn(0, 20)
    damaged = replace(lines, sigma=lines.sigma[:2])
    complaint = rf"^Anchorline.sigma: found 2 rows, expected {len(lines)}; what belongs .* field\(metadata=TABLE\)$"
    with pytest.raises(ValueError, match=complaint):
        pdr.WalkGraph(steps, fixes, measurements=[damaged])
    navigator = pdr.Navigator()
    with pytest.raises(ValueError, match=complaint):
        navigator.push(damaged)
    del KINDS[Anchorline]
    for kind, found in ((Walked, "Walked.walk: found 3 rows"), (Twofold, r"found keyframes of shape \(\d+, 2\)")):
        pdr.register(Anchorline, kind)
        with pytest.raises(ValueError, match=found):
            pdr.WalkGraph(steps, fixes, measurements=[lines])
        del KINDS[Anchorline]
    pdr.register(Anchorline, AnchorlineFactor)


@dataclass(frozen=True)
class ColouredLines(Anchorline):
    colours: tuple[str, ...] = field(default=(), metadata=pdr.TABLE)
    hue: tuple[str, ...] = ()

    def __len__(self):
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Walked(AnchorlineFactor):
    walk: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class Coloured(AnchorlineFactor):
    walk: np.ndarray = field(default_factory=lambda: np.zeros(3), metadata=pdr.TABLE)


class Twofold(AnchorlineFactor):
    @classmethod
    def of(cls, lines, steps, prior, number):
        return cls(lines, number, np.full((len(number), 2), -1))


@dataclass(frozen=True, eq=False)
class Undeclared(AnchorlineFactor):
    keyframe: np.ndarray


@dataclass(frozen=True, eq=False)
class TwiceBound(AnchorlineFactor):
    other: np.ndarray = field(metadata=pdr.KEYFRAME)


Changing = make_dataclass("Changing", ["time"])
Bound = make_dataclass("Bound", ["time", ("at", np.ndarray, field(metadata=pdr.KEYFRAME))], frozen=True)
Whole = make_dataclass("Whole", [("time", np.ndarray, field(metadata=pdr.TABLE))], frozen=True)
Listless = make_dataclass("Listless", ["time", "anchor", "label"], frozen=True, namespace={"reference": "anchor"})
Timeless = make_dataclass("Timeless", ["place"], frozen=True)
Ranges = make_dataclass("Ranges", ["time"], frozen=True)


class Nameless(AnchorlineFactor):
    name = ""


class Taken(AnchorlineFactor):
    name = "walls"


class Structural(AnchorlineFactor):
    def refined(self, at):
        """Of an interface that it does not inherit: nothing would call it."""


@pytest.mark.parametrize(
    ("data", "kind", "error", "reason"),
    [
        (Changing, AnchorlineFactor, TypeError, "frozen=True"),
        (Timeless, AnchorlineFactor, TypeError, "expected a frozen dataclass with time"),
        (Anchorline, Anchorline, TypeError, "expected subclasses of Measurement"),
        (Anchorline, Nameless, TypeError, "without a name"),
        (Anchorline, Structural, TypeError, "found Structural.refined, expected a subclass of Refined"),
        (Ranges, AnchorlineFactor, ValueError, "another type of this name is registered"),
        (pdr.Fixes, AnchorlineFactor, ValueError, "another type of this name is registered"),
        (Anchorline, Taken, ValueError, "is registered"),
        (Anchorline, Undeclared, TypeError, r"Undeclared: found keyframes \[\], expected one"),
        (Anchorline, TwiceBound, TypeError, r"TwiceBound: found keyframes \['keyframe', 'other'\], expected one"),
        (Bound, AnchorlineFactor, TypeError, "or a KEYFRAME, expected"),
        (Whole, AnchorlineFactor, TypeError, "found time declared TABLE"),
        (Listless, AnchorlineFactor, TypeError, "refer to no list, expected label"),
    ],
)
def test_what_cannot_be_registered_is_refused(data, kind, error, reason):
    with pytest.raises(error, match=reason):
        pdr.register(data, kind)


def test_what_is_not_registered_measures_nothing():
    with pytest.raises(TypeError, match="found Timeless, expected one of"):
        pdr.WalkGraph(drawn(0, 20)[0], measurements=[Timeless(np.zeros((1, 2)))])
    pdr.register(Anchorline, AnchorlineFactor)  # again, as in a notebook
    assert list(KINDS).count(Anchorline) == 1
