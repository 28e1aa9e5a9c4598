"""How many modules of the package a walk passes: from its files to the result, and from a sample to a pose."""

import sys

import numpy as np
import pytest

from pdr_graph.apps.replay import navigator_of
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.online.interface import events_of
from pdr_graph.walk import Options, estimate, observe, read

# Most modules; the aim is 25 from the files to the result, and 28 from a sample to a pose
TO_EVIDENCE, TO_RESULT, TO_POSE = 26, 45, 28


def passed(call):
    """What a call returns, and the modules of the package in which a function ran."""
    modules = set()

    def note(frame, event, _):
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.startswith("pdr_graph.") and frame.f_code.co_name != "<module>":
            modules.add(name)

    sys.setprofile(note)
    try:
        return call(), modules
    finally:
        sys.setprofile(None)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk")
    write(simulate(Scenario.load("l_corridor")), folder)
    return folder


def test_rooms_from_the_files_to_the_result(recording):
    """Without a plan, whose reader is asked for among all formats."""
    evidence, reading = passed(lambda: observe(read(recording)))
    result, estimating = passed(lambda: estimate(evidence))
    assert result.graph is not None
    assert len(reading) <= TO_EVIDENCE, sorted(reading)
    assert len(reading | estimating) <= TO_RESULT, sorted(reading | estimating)


def test_rooms_from_a_sample_to_a_pose(recording):
    """The median of the events that bring a step."""
    evidence = read(recording)
    navigator, rooms = navigator_of(Options(), evidence)(), []
    for event in events_of(evidence.walk):
        before = navigator.steps
        _, modules = passed(lambda event=event: (navigator.push(event), navigator.pose))
        if navigator.steps > before:
            rooms.append(len(modules))
    assert len(rooms) > 50
    assert np.median(rooms) <= TO_POSE
