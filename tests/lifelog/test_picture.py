"""The picture of a day: every part of the day is on a map that is large enough to show it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_days import MIDNIGHT, NOWHERE, day, outing, overview_of, stay

from pdr_graph.apps.lifelog.day import ACTIVITIES, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.maps import ENLARGED_SHARE, panels
from pdr_graph.apps.lifelog.picture import picture

MALL = "maps/mall.geojson"
HOUR = 3600.0
STROLL = [(WALKING, 300.0, 0.0), (WALKING, 300.0, 1.5)]


def indoors(floor, epoch, start=(20.0, 20.0)):
    """A walk of some metres on a plan."""
    return outing([(WALKING, 20.0, 0.0)], epoch=epoch, plan=MALL, floor=floor, start=start)


def drawn(made):
    """The picture of a day, drawn."""
    figure, _ = picture(overview_of(made))
    figure.canvas.draw()
    return figure


def test_walks_near_each_other_share_a_map():
    later = outing(STROLL, epoch=MIDNIGHT + 15 * HOUR, start=(100.0, 100.0))
    assert len(panels(overview_of(day(outing(STROLL), later)))) == 1


def test_walks_far_apart_have_enlarged_maps():
    later = outing(STROLL, epoch=MIDNIGHT + 15 * HOUR, start=(30_000.0, 0.0))
    whole, *places = panels(overview_of(day(outing(STROLL), later)))
    assert [panel.letter for panel in (whole, *places)] == ["A", "B", "C"]
    assert whole.width > 30_000
    for place in places:
        assert place.width < ENLARGED_SHARE * whole.width
        assert any((place.corners[0] < way[0].position[0]).all() for way in place.ways)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_every_walk_is_on_some_map(seed):
    """Each row is within the corners of a map; the map of everything has all."""
    random = np.random.default_rng(seed)
    outings = []
    for n in range(random.integers(1, 4)):
        legs = [
            (str(random.choice(ACTIVITIES)), float(random.uniform(10, 900)), float(random.uniform(-3, 3)))
            for _ in range(4)
        ]
        outings.append(outing([*legs, *STROLL], epoch=MIDNIGHT + n * 4 * HOUR, start=random.uniform(-5000, 5000, 2)))
    whole, *_ = panels(overview_of(day(*outings)))
    for way in (track for own in whole.ways for track in own):
        assert ((way.position >= whole.corners[0]) & (way.position <= whole.corners[1])).all()


def test_each_floor_has_a_map_of_its_own_tracks():
    made = day(indoors("1", MIDNIGHT + 9 * HOUR), indoors("2", MIDNIGHT + 10 * HOUR))
    made = replace(made, outings=(replace(made.outings[0], stays=(stay(0, 5, (20, 20), floor="1"),)), made.outings[1]))
    first, second = panels(overview_of(made))
    assert (first.floor, second.floor) == ("1", "2")
    assert (len(first.dots), len(second.dots)) == (1, 0)
    assert {d.floor for d in first.drawn} == {"1"}


def test_a_change_of_floor_is_on_both_maps():
    made = indoors("1", MIDNIGHT)
    floor = tuple("1" if t < 10 else "2" for t in made.trajectory.time)
    made = replace(made, trajectory=replace(made.trajectory, floor=floor))
    assert [panel.floor for panel in panels(overview_of(day(made)))] == ["1", "2"]


@pytest.mark.filterwarnings("ignore:Glyph")  # where no font has Japanese
@pytest.mark.parametrize(
    "made",
    [
        day(),
        day(outing([(WALKING, 1.0, 0.0)])),
        day(replace(outing(STROLL), segments=())),
        day(outing(STROLL, frame=NOWHERE), outing(STROLL, epoch=MIDNIGHT + 20 * HOUR)),
        day(outing([(STANDING, 40_000.0, 0.0)], stays=[stay(0, 40_000, facing=[("店" * 40, 0.5)])])),
        day(indoors("1", MIDNIGHT), outing([(VEHICLE, 3000.0, 0.0)], epoch=MIDNIGHT + HOUR)),
        day(replace(indoors("1", MIDNIGHT), plan="nowhere.geojson")),
        day(replace(outing(STROLL), trajectory=replace(outing(STROLL).trajectory, covariance=None))),
        day(*(outing(STROLL, epoch=MIDNIGHT + n * HOUR, start=(n * 5000.0, 0.0)) for n in range(9))),
    ],
    ids=["nothing", "a step", "one fix", "nowhere", "a name", "a plan and a ride", "no plan", "no covariance", "many"],
)
def test_every_day_can_be_drawn(made):
    figure = drawn(made)
    assert np.ptp(np.asarray(figure.canvas.buffer_rgba())[:, :, :3]) > 100  # something is on it
    assert figure.get_figheight() < 25


def test_labels_do_not_overlap_and_stay_on_their_map():
    """Measured by the renderer, with many stays on one spot."""
    random = np.random.default_rng(2)
    stays = [stay(n, n + 1, random.normal(0, 40, 2), [(f"Shop number {n}", 0.9)]) for n in range(0, 590, 20)]
    figure = drawn(day(outing(STROLL, stays=stays)))
    axes = figure.axes[0]
    boxes = [t.get_window_extent() for t in axes.texts if t.get_text().startswith("Shop")]
    assert len(boxes) > 5
    for n, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:n])
        assert axes.bbox.contains(box.x0, box.y0)
        assert axes.bbox.contains(box.x1, box.y1)


def test_the_scale_bar_has_the_length_of_its_label():
    figure = drawn(day(outing(STROLL)))
    axes = figure.axes[0]
    bar = next(line for line in axes.lines if line.get_linewidth() == 2.5)
    label = next(t.get_text() for t in axes.texts if t.get_text().endswith(" m"))
    assert np.ptp(bar.get_xdata()) == pytest.approx(float(label.split()[0]))
