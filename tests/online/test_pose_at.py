"""`Navigator.at`: the pose of a walk under way at any time that is known."""

import numpy as np
import pytest
from walks import drawn_from_the_model, part

from pdr_graph import Navigator
from pdr_graph.geometry import wrap_angle


def walked(n=260, lag=30.0):
    """A navigator after a walk from the model, each fix in its time."""
    steps, fixes, _ = drawn_from_the_model(n, 3)
    nav, before = Navigator(lag=lag, executor=None), -np.inf
    for k in range(n):
        chunk = part(steps, k, k + 1)
        nav.push(chunk)
        for f in np.flatnonzero((fixes.time > before) & (fixes.time <= chunk.end)):
            nav.push(fixes[int(f)])
        before = chunk.end
    return nav


def test_at_the_times_of_rows_it_is_the_trajectory():
    """Finalised, in the window, and predicted after the last keyframe."""
    nav = walked()
    track, times = nav.trajectory, nav._window.times
    rows = [*range(0, len(track), 9), *range(len(track) - 12, len(track))]
    assert track.time[0] < times[0] < times[-1] < track.time[-1]
    for n in rows:
        pose = nav.at(float(track.time[n]))
        assert (pose.x, pose.y) == pytest.approx(tuple(track.position[n]), abs=1e-9)
        assert abs(wrap_angle(pose.heading - track.heading[n])) < 1e-9
        assert pose.covariance == pytest.approx(track.covariance[n], abs=1e-9)
    now = nav.pose
    assert nav.at(now.time).x == pytest.approx(now.x, abs=1e-9)


def test_between_rows_it_is_between_them():
    nav = walked(120)
    track = nav.trajectory
    for n in range(len(track) - 1):
        pose = nav.at(float(track.time[n] + track.time[n + 1]) / 2)
        assert np.hypot(*(np.array([pose.x, pose.y]) - track.position[n : n + 2].mean(axis=0))) < 0.3
        assert np.linalg.eigvalsh(pose.covariance).min() > 0


def test_times_without_a_pose_raise_an_error_that_says_which_there_are():
    nav = walked()
    assert len(nav.finalized())
    track = nav.trajectory
    for time in (0.0, track.time[0] - 0.01, track.time[-1] + 0.01, np.nan):
        with pytest.raises(ValueError, match=rf"poses are known for {track.time[0]:.3f} to {track.time[-1]:.3f} s"):
            nav.at(time)
    with pytest.raises(ValueError, match="none before the first steps"):
        Navigator().at(0.0)
