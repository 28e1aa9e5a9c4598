"""The second tier of parametrised tests."""

import pytest


def thorough(*values, **more):
    """A case of `pytest.mark.parametrize` that runs only with --all."""
    return pytest.param(*values, marks=pytest.mark.thorough, **more)
