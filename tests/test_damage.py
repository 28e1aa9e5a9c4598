"""Damaged inputs load or raise one line; after a power cut files come back to the last whole record, and say the loss.

``scripts/fuzz.py`` does the same a hundred thousand times.
"""

import random
import warnings

import numpy as np
import pytest
from mutations import PLAN_SCALES, inputs, mutated, simulated_if_short
from power_loss import CHANGED, DAMAGES, FAILED, TARGETS, UNNOTICED, count

from pdr_graph import InputError, read_fixes, read_trajectory
from pdr_graph.apps import cli
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.io.loading import load
from pdr_graph.recovery import DataLossWarning
from pdr_graph.types import Recording, Signal

WALK = Recording("walk", 1.7e9, 1.7e9, accelerometer=Signal(np.arange(0.0, 60.0, 0.02), np.zeros((3000, 3))))
COPIES, OF_DRAWINGS = 100, 20  # a drawing that is read takes half a second
OLDER = r"(ezdxf|matplotlib|pyparsing|pyproj)\."  # their older versions use what numpy and pyparsing will drop
TABLES = {"fixes": lambda path: read_fixes(path, WALK), "scenario": simulated_if_short, "trajectory": read_trajectory}


def survive(name, undamaged, use, folder, copies=COPIES):
    """Read damaged copies, some of which load (a control), while some raise one line without control characters."""
    file, whole = undamaged
    loaded, errors = 0, []
    for n in range(copies):
        (folder / file).write_bytes(mutated(whole, random.Random(f"{name}{n}")))
        try:
            with warnings.catch_warnings(action="error"):
                warnings.filterwarnings("ignore", category=DeprecationWarning, module=OLDER)
                use(folder / file)
            loaded += 1
        except InputError as error:
            errors.append(str(error))
    assert loaded, f"{name}: nothing was read"
    assert errors, f"{name}: nothing was refused"
    assert [text for text in errors if not text.isprintable() or len(text) >= 1000] == []


def test_a_damaged_table_and_recording(tmp_path):
    recordings, tables, _ = inputs()
    survive("fixes", tables["fixes"], TABLES["fixes"], tmp_path, 30)
    survive("gnss_logger", recordings["gnss_logger"], load, tmp_path, 15)


@pytest.mark.thorough
def test_every_damaged_input(tmp_path):
    recordings, tables, plans = inputs()
    for name, undamaged in recordings.items():
        survive(name, undamaged, load, tmp_path)
    for name, undamaged in tables.items():
        survive(name, undamaged, TABLES[name], tmp_path)
    for name, undamaged in plans.items():
        scale, copies = PLAN_SCALES.get(name), OF_DRAWINGS if name in PLAN_SCALES else COPIES
        survive(name, undamaged, lambda path, scale=scale: problems(Building.load(path, scale)), tmp_path, copies)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", TARGETS)
def test_damaged_files_come_back_with_a_line_or_are_refused_unchanged(kind, tmp_path):
    """A changed value may be another value."""
    target, failures = TARGETS[kind](tmp_path), list[str]()
    for damage in DAMAGES:
        outcomes = count(target, damage, 5, tmp_path / "store", failures.append)
        assert not outcomes[FAILED], failures
        assert damage == "old" or not outcomes[UNNOTICED]
        assert damage == "flip" or not outcomes[CHANGED]


def test_a_journal_cut_short_comes_back_with_a_line(tmp_path):
    outcomes = count(TARGETS["journal"](tmp_path), "cut", 3, tmp_path / "store")
    assert not outcomes[FAILED] + outcomes[UNNOTICED] + outcomes[CHANGED]


def test_the_commands_say_a_loss_in_one_line(capsys):
    cli._show_warning(DataLossWarning("log: damaged"), DataLossWarning)
    assert capsys.readouterr().err == "pdr-graph: log: damaged\n"
