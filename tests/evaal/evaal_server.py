"""A small server of the EvAAL API, written from its description. Trial time is virtual: tests do not wait."""

from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit

from stand_in_server import QuietHandler, served


def time_of(row):
    return float(row.replace("\t", ";").replace(",", ";").split(";")[1])


@dataclass
class Trial:
    """One trial. took: virtual duration of each request [s].

    faults: number of a request for data -> its fault: an HTTP code; "away" or "lost", no answer before or after the
    trial advances; "cut", half an answer; "dies …", no answer from then on.
    """

    rows: list
    initial: str = ""
    speed: float = 3.0
    slack: float = 15.0
    offline: bool = False
    took: float = 0.0
    faults: dict = field(default_factory=dict)
    log: list = field(default_factory=list)
    estimates: list = field(default_factory=list)  # (time, position)
    sent_rows: int = 0  # each counted once, when it is sent for the first time
    calls: int = 0
    down: bool = False

    def __post_init__(self):
        self.limit, self.position, self.horizon, self.now, self.asked = self.slack, self.initial, 0.0, 0.0, 0.0
        self.time, self.begun, self.over, self.last = time_of(self.rows[0]), False, False, None

    @property
    def left(self):
        if not self.begun:
            return -2.0 if self.offline else -1.0
        return max(time_of(self.rows[-1]) - self.time, 0.0)

    def state(self):
        numbers = (self.time, self.left, self.speed, self.slack, self.asked, self.horizon, self.time)
        return ",".join(f"{n:.3f}" for n in numbers) + "," + self.position

    def next_data(self, query):
        if self.over or ("offline" in query and self.begun):
            self.over = True
            return 405, self.state()
        if "offline" in query:
            self.begun, self.sent_rows = True, len(self.rows)
            return 200, "\n".join(self.rows) + "\n"
        label = query.get("label", [None])[0]
        if self.last is not None and label is not None and label == self.last[0]:
            return 200, self.last[1]
        if self.begun:
            self.slack = min(self.limit, self.slack + self.speed * self.horizon - (self.now - self.asked))
            if "position" in query:
                self.position = query["position"][0]
                self.estimates.append((self.time, self.position))
        self.begun, self.asked, self.horizon = True, self.now, float(query.get("horizon", ["0.5"])[0])
        if self.slack < 0 or self.sent_rows == len(self.rows):
            self.over = True
            return 405, self.state()
        self.time += self.horizon
        first = self.sent_rows
        while self.sent_rows < len(self.rows) and time_of(self.rows[self.sent_rows]) < self.time:
            self.sent_rows += 1
        body = "".join(row + "\n" for row in self.rows[first : self.sent_rows])
        self.last = (label, body)
        return 200, body

    def take(self, content_type, body):
        if content_type != "text/csv; charset=us-ascii":
            return 400, "charset"
        if self.over:
            return 405, self.state()
        for line in body.decode("ascii").splitlines():
            time, position = line.split(",", 1)
            self.estimates.append((float(time), position))
        self.over = True
        return 201, ""


class Handler(QuietHandler):
    def do_GET(self):
        parts = urlsplit(self.path)
        name, _, verb = unquote(parts.path).removeprefix("/evaalapi/").partition("/")
        trial = self.server.trials.get(name)
        if trial is None:
            return self.answer(404, "unknown trial")
        if trial.down:
            return self.connection.close()
        trial.log.append(self.path)
        texts = {"state": trial.state(), "log": "\n".join(trial.log) + "\n"}
        if verb != "nextdata":
            return self.answer(200 if verb in texts else 404, texts.get(verb, "unknown call"))
        trial.calls += 1
        trial.now += trial.took
        fault = trial.faults.get(trial.calls)
        trial.down = str(fault).startswith("dies")
        if fault in ("away", "dies before it counts"):
            return self.connection.close()
        if isinstance(fault, int):
            return self.answer(fault, "not now")
        code, body = trial.next_data(parse_qs(parts.query, keep_blank_values=True))
        if fault in ("lost", "dies after it counted"):
            return self.connection.close()
        return self.answer(code, body, cut=fault == "cut")

    def do_POST(self):
        name = unquote(self.path).removeprefix("/evaalapi/").partition("/")[0]
        trial = self.server.trials[name]
        trial.log.append(self.path)
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.answer(*trial.take(self.headers["Content-type"], body))

    def answer(self, code, text, cut=False):
        body = text.encode("utf-8")
        self.send_response(code)
        self.send_header("Content-Type", "text/plain")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: len(body) // 2] if cut else body)


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request, client_address):
        pass  # connections that a test closed


@contextmanager
def serving(**trials):
    """The base URL of a server of these trials."""
    with served(Handler, Server) as server:
        server.trials = trials
        yield f"http://127.0.0.1:{server.server_port}/evaalapi/"
