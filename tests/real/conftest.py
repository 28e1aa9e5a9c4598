"""Real recordings by others live outside the project: in ../shared/data or $PDR_GRAPH_DATA."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("PDR_GRAPH_DATA", Path(__file__).parents[3] / "shared" / "data"))


@pytest.fixture(scope="session")
def data():
    """The folder of real recordings; a test that needs it skips, or fails under PDR_GRAPH_REQUIRE_DATA=1."""
    if not DATA.is_dir():
        reason = f"no real recordings at {DATA}: set PDR_GRAPH_DATA, get them by scripts/data.py"
        if os.environ.get("PDR_GRAPH_REQUIRE_DATA") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return DATA
