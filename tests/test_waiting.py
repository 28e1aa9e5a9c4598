"""Nothing waits for ever: each wait in the package has a limit, or is in a list here that says what limits it."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HOUSE = ROOT / "pdr_graph"
# Methods without an argument, and functions without a timeout, that wait until something else has happened
METHODS = {"result", "join", "wait", "get", "recv", "recv_bytes", "acquire", "communicate", "accept", "shutdown"}
FUNCTIONS = {
    "urlopen",
    "urllib.request.urlopen",
    "socket.create_connection",
    "subprocess.run",
    "subprocess.check_output",
    "subprocess.check_call",
    "asyncio.to_thread",
    "sqlite3.connect",
    "input",
    "sys.stdin.read",
}
LIMITS = {"timeout", "timeout_seconds"}
# File and call: what limits it
LIMITED = {
    (
        "estimation/live/live_ambiguity.py",
        "self._future.result()",
    ): "a computation of this process; serve replaces an estimating process after LONGEST_SILENCE",
    ("apps/cli/terminal.py", "SILENT.get()"): "no wait: a variable of this context",
    ("errors.py", "SILENT.get()"): "no wait: a variable of this context",
    ("floor/formats/pdf_page.py", "item.get_matrix().get()"): "no wait: a matrix of pypdfium2",
    (
        "apps/lifelog/workers.py",
        "thread.submit(asyncio.run, greet()).result()",
    ): "greet ends after CONNECT_TIMEOUT + 1 s",
    ("apps/lifelog/workers.py", "future.result()"): "the future is done",
    ("apps/lifelog/workers.py", "executor.shutdown(wait=True)"): "its processes were killed",
    ("apps/serve/application.py", "websocket.accept()"): "the handshake was read by uvicorn before",
    ("apps/serve/estimators.py", "connection.recv_bytes()"): "the end of the serving process closes the connection",
    (
        "apps/serve/estimators.py",
        "self._executor.shutdown(cancel_futures=True)",
    ): "the serving process kills after STOPPING",
    (
        "apps/serve/estimators.py",
        "running.connection.recv_bytes()",
    ): "a daemon thread; LONGEST_SILENCE limits its process",
    ("apps/serve/publishing.py", "self._changed.wait()"): "within asyncio.wait_for",
    ("apps/serve/serving.py", "pool.shutdown(wait=False, cancel_futures=True)"): "no wait; end_all kills what is left",
    ("apps/serve/study.py", "process.communicate()"): "within asyncio.wait_for",
    ("apps/serve/study.py", "process.wait()"): "the process was killed",
    ("apps/serve/study.py", "self._changed.wait()"): "for the next upload, until the server ends and cancels it",
    (
        "recovery.py",
        "sqlite3.connect(path, LOCK_CALL, isolation_level=None, check_same_thread=False)",
    ): "LOCK_CALL is its timeout, and _begin ends after LOCK_TIMEOUT",
    ("apps/lifelog/store.py", "sqlite3.connect(':memory:')"): "it is in memory",
    ("recovery.py", "sqlite3.connect(address, LOCK_CALL, uri=True)"): "LOCK_CALL is its timeout",
}


def calls(path):
    """Each call in a file that may wait without a limit, as text."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or any(keyword.arg in LIMITS for keyword in node.keywords):
            continue
        text = ast.unparse(node.func)
        method = isinstance(node.func, ast.Attribute) and node.func.attr in METHODS and not node.args
        if method or text in FUNCTIONS:
            yield ast.unparse(node)


def test_each_wait_has_a_limit():
    """A new one gets a timeout; or an entry in LIMITED, if something else ends it."""
    found = {(path.relative_to(HOUSE).as_posix(), call) for path in HOUSE.rglob("*.py") for call in calls(path)}
    assert found == LIMITED.keys()


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("future.result()", 1),
        ("future.result(timeout=5)", 0),
        ("lock.acquire()", 1),
        ("', '.join(names)", 0),
        ("urlopen(request)", 1),
        ("urlopen(request, timeout=5)", 0),
        ("await asyncio.to_thread(fetch)", 1),
    ],
)
def test_the_search_finds_waits(text, number, tmp_path):
    file = tmp_path / "room.py"
    file.write_text(text)
    assert len(list(calls(file))) == number


def test_no_test_waits_without_a_limit(pytestconfig):
    assert float(pytestconfig.getini("timeout")) <= 600
