import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))
sys.path.append(str(Path(__file__).parents[1] / "scripts" / "examples" / "evaal"))

settings.register_profile("steady", derandomize=True, deadline=None)  # a failure is one of the commit, not of the day
settings.load_profile("steady")


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="run the tests marked `thorough` too")


def pytest_collection_modifyitems(config, items):
    """Leave the second tier out, unless it is asked for."""
    if not config.getoption("all"):
        left_out = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("thorough")]


@pytest.fixture
def scripts_on_path(monkeypatch):
    """The modules in scripts/ can be imported."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "scripts"))


@pytest.fixture(scope="session")
def arcade_walk(tmp_path_factory):
    """A walk of 27 s through the arcade, as Sensor Logger writes it, with plan, fixes and truth; only to be read."""
    import simulated

    return simulated.arcade(tmp_path_factory.mktemp("arcade") / "walk")


@pytest.fixture(scope="session")
def long_walk(tmp_path_factory):
    """A walk of a minute along `simulated.ROUTE`: walk.txt, fixes.csv with outliers, truth.csv; only to be read."""
    import simulated

    return simulated.indoor_location(tmp_path_factory.mktemp("long"), simulated.ROUTE, seed=4)
