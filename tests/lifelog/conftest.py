import pytest
from made_month import made_store


@pytest.fixture(scope="session")
def month_log(tmp_path_factory):
    """A lifelog of Ada and Ben: May 2024 in Berlin, from the 21st on in Tokyo. No test changes it."""
    return made_store(tmp_path_factory.mktemp("month") / "days.db", "Ada", "Ben")
