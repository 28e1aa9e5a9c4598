"""Nothing waits for ever: each wait in the package has a limit, or is in a list here that says what limits it."""

import ast

from source import FILES, name_of, tree_of

# Methods without an argument, and functions without a timeout, that wait until something else has happened
METHODS = {"result", "join", "wait", "get", "recv", "recv_bytes", "acquire", "communicate", "accept", "shutdown"}
FUNCTIONS = {"urlopen", "urllib.request.urlopen", "socket.create_connection", "asyncio.to_thread", "sqlite3.connect"}
FUNCTIONS |= {"subprocess.run", "subprocess.check_output", "subprocess.check_call", "input", "sys.stdin.read"}
LAST_NAMES = METHODS | {name.split(".")[-1] for name in FUNCTIONS}
LIMITS = {"timeout", "timeout_seconds"}
# File and call: what limits it
LIMITED = {
    "estimation/live/live_ambiguity.py: self._future.result()": "this process computes; LONGEST_SILENCE replaces it",
    "apps/cli/lifelog.py: SILENT.get()": "no wait: a variable of this context",
    "apps/cli/terminal.py: SILENT.get()": "no wait: a variable of this context",
    "errors.py: SILENT.get()": "no wait: a variable of this context",
    "floor/formats/pdf_page.py: item.get_matrix().get()": "no wait: a matrix of pypdfium2",
    "apps/lifelog/workers.py: thread.submit(asyncio.run, greet()).result()": "greet ends after CONNECT_TIMEOUT + 1 s",
    "apps/lifelog/workers.py: future.result()": "the future is done",
    "apps/lifelog/workers.py: executor.shutdown(wait=True)": "its processes were killed",
    "apps/lifelog/store.py: sqlite3.connect(':memory:')": "it is in memory",
    "apps/serve/application.py: websocket.accept()": "the handshake was read by uvicorn before",
    "apps/serve/estimators.py: connection.recv_bytes()": "the end of the serving process closes the connection",
    "apps/serve/estimators.py: self._executor.shutdown(cancel_futures=True)": "the server kills after STOPPING",
    "apps/serve/estimators.py: running.connection.recv_bytes()": "a daemon thread; LONGEST_SILENCE limits its process",
    "apps/serve/publishing.py: self._changed.wait()": "within asyncio.wait_for",
    "apps/serve/serving.py: pool.shutdown(wait=False, cancel_futures=True)": "no wait; end_all kills what is left",
    "apps/serve/study.py: process.communicate()": "within asyncio.wait_for",
    "apps/serve/study.py: process.wait()": "the process was killed",
    "apps/serve/study.py: self._changed.wait()": "for the next upload, until the server ends and cancels it",
    "recovery.py: sqlite3.connect(path, LOCK_CALL, isolation_level=None, check_same_thread=False)": "LOCK_CALL",
    "recovery.py: sqlite3.connect(':memory:', isolation_level=None, check_same_thread=False)": "nobody else's memory",
    "recovery.py: sqlite3.connect(address, LOCK_CALL, uri=True)": "LOCK_CALL is its timeout",
}


def calls(path):
    """Each call in a file that may wait without a limit, as text."""
    for node in ast.walk(tree_of(path)):
        if not isinstance(node, ast.Call) or getattr(node.func, "attr", getattr(node.func, "id", "")) not in LAST_NAMES:
            continue
        if any(keyword.arg in LIMITS for keyword in node.keywords):
            continue
        method = isinstance(node.func, ast.Attribute) and node.func.attr in METHODS and not node.args
        if method or ast.unparse(node.func) in FUNCTIONS:
            yield f"{name_of(path)}: {ast.unparse(node)}"


def test_each_wait_has_a_limit():
    """A new one gets a timeout; or an entry in LIMITED, if something else ends it."""
    assert {call for path in FILES for call in calls(path)} == LIMITED.keys()


def test_no_test_waits_without_a_limit(pytestconfig):
    assert float(pytestconfig.getini("timeout")) <= 600
