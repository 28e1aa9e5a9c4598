import pytest


@pytest.fixture
def anyio_backend():
    """What runs the tests that are coroutines."""
    return "asyncio"
