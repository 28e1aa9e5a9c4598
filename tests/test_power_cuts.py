"""After a power cut a walk, a lifelog and a session come back to the last whole record, and the loss is said.

``scripts/power_cuts.py`` counts a thousand cuts of each.
"""

import pytest
from power_loss import CHANGED, DAMAGES, FAILED, TARGETS, UNNOTICED, count

import pdr_graph.apps.cli
from pdr_graph.recovery import DataLossWarning


@pytest.fixture(scope="module", params=TARGETS)
def target(request, tmp_path_factory):
    """Each kind of file, with the folder in which it is damaged."""
    folder = tmp_path_factory.mktemp("cuts")
    return TARGETS[request.param](folder), folder / "store"


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_come_back_with_a_line_or_are_refused_unchanged(target, damage):
    """A changed value may be another value."""
    failures = list[str]()
    outcomes = count(target[0], damage, 5, target[1], failures.append)
    assert not outcomes[FAILED], failures
    assert damage == "old" or not outcomes[UNNOTICED]
    assert damage == "flip" or not outcomes[CHANGED]


def test_the_commands_say_a_loss_in_one_line(capsys):
    pdr_graph.apps.cli._show_warning(DataLossWarning("log: damaged"), DataLossWarning)
    assert capsys.readouterr().err == "pdr-graph: log: damaged\n"
