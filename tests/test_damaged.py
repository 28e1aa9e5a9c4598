"""Damaged inputs load or raise InputError of one line; ``scripts/fuzz.py`` does the same a hundred thousand times."""

import random
import warnings

import numpy as np
import pytest
from mutations import PLAN_SCALES, inputs, mutated, simulated_if_short

from pdr_graph import InputError, read_fixes, read_trajectory
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.io.loading import load
from pdr_graph.types import Recording, Signal

RECORDINGS, TABLES, PLANS = inputs()
WALK = Recording("walk", 1.7e9, 1.7e9, accelerometer=Signal(np.arange(0.0, 60.0, 0.02), np.zeros((3000, 3))))
COPIES, OF_DRAWINGS = 100, 20  # a drawing that is read takes half a second
OLDER = r"(ezdxf|matplotlib|pyparsing|pyproj)\."  # their older versions use what numpy and pyparsing will drop


def survive(name, undamaged, use, folder):
    file, whole = undamaged
    loaded, errors = 0, []
    for n in range(OF_DRAWINGS if name in PLAN_SCALES else COPIES):
        (folder / file).write_bytes(mutated(whole, random.Random(f"{name}{n}")))
        try:
            with warnings.catch_warnings(action="error"):
                warnings.filterwarnings("ignore", category=DeprecationWarning, module=OLDER)
                use(folder / file)
            loaded += 1
        except InputError as error:
            errors.append(str(error))
    assert loaded, "a control: some damage has no effect"
    assert errors, "a control: some damage raises"
    assert all(text.isprintable() for text in errors), "one line, without control characters"
    assert max(map(len, errors)) < 1000


@pytest.mark.parametrize("name", RECORDINGS)
def test_damaged_recordings(name, tmp_path):
    survive(name, RECORDINGS[name], load, tmp_path)


@pytest.mark.parametrize("name", PLANS)
def test_damaged_plans(name, tmp_path):
    def check(path):
        problems(Building.load(path, PLAN_SCALES.get(name)))

    survive(name, PLANS[name], check, tmp_path)


def test_damaged_tables(tmp_path):
    survive("fixes", TABLES["fixes"], lambda path: read_fixes(path, WALK), tmp_path)
    survive("scenario", TABLES["scenario"], simulated_if_short, tmp_path)
    survive("trajectory", TABLES["trajectory"], read_trajectory, tmp_path)
