import contextlib
import os
import shutil
import socket
import subprocess

import pytest
from streamed_walks import until

FOLDERS = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/usr/local/sbin", "/opt/homebrew/sbin"])
MOSQUITTO = shutil.which("mosquitto", path=FOLDERS)


@pytest.fixture
def anyio_backend():
    """What runs the tests that are coroutines."""
    return "asyncio"


def accepts(port):
    """True once somebody listens."""
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


@pytest.fixture
def port(tmp_path):
    """The port of a Mosquitto of its own."""
    if MOSQUITTO is None:
        pytest.skip("there is no mosquitto")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        free = probe.getsockname()[1]
    settings = tmp_path / "mosquitto.conf"
    settings.write_text(f"listener {free} 127.0.0.1\nallow_anonymous true\n")
    with subprocess.Popen([MOSQUITTO, "-c", settings], stderr=subprocess.DEVNULL) as process:
        until(lambda: accepts(free))
        yield free
        process.terminate()
