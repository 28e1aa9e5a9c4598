"""The EvAAL API, by which competitions give a trial's rows and take positions; and the log of all requests on disk.

The server is untrusted and may be slow, gone for a while or in error. Each call for data takes the trial on by some
time, so that a repeated one would lose rows: `Api.next_data` repeats a call under the same label, to which the server
gives the same rows. `Api.all_data` is never repeated, since a second call ends an offline trial.

With the log, a client that was killed goes on. ``requests.log`` has a line for each request before it is sent and one
when its rows are safe in ``received.txt``::

    trial<TAB>URL<TAB>TRIAL        initial<TAB>POSITION
    ask<TAB>LABEL<TAB>UNIX TIME<TAB>POSITION        got<TAB>LABEL<TAB>BYTES OF received.txt
    end<TAB>STATE

A request without its ``got`` is sent again under the same label, and the server repeats its answer.
"""

from __future__ import annotations

import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse, IncompleteRead
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import quote, urlsplit

from pdr_graph.errors import InputError

NOT_BEGUN, NOT_BEGUN_OFFLINE = -1.0, -2.0  # what is left of a trial before its first call
GOOD, CREATED = 200, 201
SOME_REJECTED, UNKNOWN, OVER, TOO_FAST = 409, 404, 405, 423
AGAIN = (TOO_FAST, 429, 502, 503, 504)  # the server says "later", or one before it that it is away
TRIES, FIRST_PAUSE = 10, 0.05  # of one call, and [s] after the first; each pause is twice the last: 26 s in all
SILENCE, LONGEST_CALL = 10.0, 120.0  # [s] without a byte, and of one call
MOST_ROWS, MOST_TEXT = 4_000_000, 100_000  # bytes of a slot's rows, some hundred times a phone's; of a state
MOST_DATA = 1_000_000_000  # bytes of a whole trial or its log
CSV = "text/csv; charset=us-ascii"  # the one header that the server takes
NEEDED = {
    UNKNOWN: "the base URL, which ends in /evaalapi/, and the trial's name as the organisers gave them",
    OVER: "a trial that has not ended",
}


class UnreachableError(OSError):
    """The server gave no answer, however often it was asked."""


@dataclass(frozen=True)
class State:
    """A trial as the server has it: ``trialts,rem,V,S,p,h,pts,pos``.

    time: to which its rows were handed out [s]; left: of it [s], negative before its first call; speed: trial time
    per time [-]; slack: time ahead of the timeout [s]; position: the last that was sent, before that the initial one.
    """

    time: float
    left: float
    speed: float
    slack: float
    position: str
    text: str

    @classmethod
    def parse(cls, text: str) -> State | None:
        """None if it is none. A position may itself hold commas."""
        fields = text.strip().split(",", 7)
        try:
            ts, left, speed, slack, _, _, _ = (float(field) for field in fields[:7])
        except ValueError:
            return None
        return cls(ts, left, speed, slack, fields[7].strip() if len(fields) > 7 else "", text.strip())

    @property
    def offline(self) -> bool:
        """Whether the trial is an offline one that has not begun; afterwards its state no longer tells."""
        return self.left == NOT_BEGUN_OFFLINE

    @property
    def begun(self) -> bool:
        """Whether any rows were handed out."""
        return self.left not in (NOT_BEGUN, NOT_BEGUN_OFFLINE)

    @property
    def timed_out(self) -> bool:
        """Of a trial that is over: whether it was cut off, with rows left or no slack."""
        return self.left > 0 or self.slack < 0


@dataclass(frozen=True)
class Reply:
    """What came back. seconds: from the first try to the answer; tries: how often it took."""

    code: int
    body: bytes
    seconds: float
    tries: int

    @property
    def text(self) -> str:
        """The body, which is ASCII; what is not is marked."""
        return self.body.decode("ascii", errors="replace")


class Api:
    """One trial of one server."""

    def __init__(self, url: str, trial: str, sleep: Callable[[float], None] = time.sleep):
        """Raises InputError if the URL is none of the web."""
        try:
            parts = urlsplit(url)
            valid = parts.scheme in ("http", "https") and bool(parts.hostname) and url.isascii() and url.isprintable()
        except ValueError:
            valid = False
        if not valid or not trial:
            raise InputError("evaal", "", f"{url!r} and trial {trial!r}", "http://…/evaalapi/ and a trial's name")
        self.url, self.trial = url.rstrip("/") + "/", trial
        self._base, self._sleep = self.url + quote(trial, safe="") + "/", sleep

    def state(self, tries: int = TRIES) -> State:
        """How the trial stands. Raises InputError if there is none such, or something else answers."""
        try:
            reply = self._ask("state", tries=tries)
        except UnreachableError as error:
            raise InputError(self.url, self.trial, str(error), "a server of the EvAAL API") from None
        state = State.parse(reply.text) if reply.code in (GOOD, OVER) else None
        if state is None:
            raise self.refusal(reply)
        return state

    def next_data(self, label: str, position: str, horizon: float) -> Reply:
        """The rows of the next ``horizon`` [s], or 405 at the end; ``position``, if any, is for the time before them.

        Under a label that the server has had it repeats its answer. Raises UnreachableError.
        """
        query = f"nextdata?horizon={horizon:g}&label={quote(label, safe='')}"
        return self._ask(query + (f"&position={quote(position, safe=',;')}" if position else ""), most=MOST_ROWS)

    def all_data(self) -> Reply:
        """All rows of an offline trial, which can be had once. Raises UnreachableError."""
        return self._ask("nextdata?offline", most=MOST_DATA, tries=1)

    def post_estimates(self, lines: str) -> Reply:
        """Send ``time,position`` lines of an offline trial: 201 if all were taken. Raises UnreachableError."""
        return self._ask("estimates", lines.encode("ascii"))

    def log(self) -> bytes:
        """The server's log of the trial; empty where it gives none."""
        try:
            reply = self._ask("log", most=MOST_DATA, tries=1)
        except (UnreachableError, InputError):
            return b""
        return reply.body if reply.code == GOOD else b""

    def refusal(self, reply: Reply) -> InputError:
        """What to say of an answer that is of no use."""
        found = f"{reply.code} {reply.text[:200].strip()!r}" if reply.body else f"{reply.code}"
        return InputError(self.url, self.trial, found, NEEDED.get(reply.code, "an answer of the EvAAL API"))

    def _ask(self, query: str, data: bytes | None = None, most: int = MOST_TEXT, tries: int = TRIES) -> Reply:
        """One call, repeated while the server is away or says "later"."""
        started, found = time.monotonic(), ""
        for n in range(tries):
            if n:
                self._sleep(FIRST_PAUSE * 2 ** (n - 1))
            try:
                code, body = self._once(query, data, most)
            except (OSError, HTTPException) as error:
                found = f"no answer ({getattr(error, 'reason', None) or error or type(error).__name__})"
                continue
            if code not in AGAIN:
                return Reply(code, body, time.monotonic() - started, n + 1)
            found = f"{code} {body[:100]!r}"
        raise UnreachableError(f"{found} after {tries} {'try' if tries == 1 else 'tries'}")

    def _once(self, query: str, data: bytes | None, most: int) -> tuple[int, bytes]:
        """A 4xx is an answer like any other: the normal end of a trial is one."""
        request = urllib.request.Request(self._base + query, data, {"Content-type": CSV} if data else {})
        try:
            with urllib.request.urlopen(request, timeout=SILENCE) as response:
                return response.status, self._read(response, most)
        except HTTPError as error:
            with error:
                return error.code, error.read(MOST_TEXT)

    def _read(self, response: HTTPResponse, most: int) -> bytes:
        """A whole body. Raises IncompleteRead if it was cut off, InputError if it is beyond measure."""
        body, until = bytearray(), time.monotonic() + LONGEST_CALL
        while piece := response.read1(1 << 16):
            body += piece
            if len(body) > most:
                raise InputError(self.url, self.trial, f"an answer of more than {most} bytes", "rows of sensors")
            if time.monotonic() > until:
                raise TimeoutError(f"an answer that takes longer than {LONGEST_CALL:.0f} s")
        whole = response.headers.get("Content-Length", "")
        if whole.isdecimal() and len(body) < int(whole):
            raise IncompleteRead(bytes(body), int(whole) - len(body))
        return bytes(body)


OFFLINE = "offline"  # the label of the one request of an offline trial


class RequestLog:
    """The requests of one trial, kept in a folder.

    asked: label and position of each request; sizes: of ``received.txt`` after each that was answered [bytes];
    initial: the trial's initial position, None until it is noted; end: the state in which it ended, None before.
    """

    def __init__(self, folder: Path, url: str, trial: str):
        """Take up what is there. Raises InputError if it is of another trial, or damaged."""
        folder.mkdir(parents=True, exist_ok=True)
        self.path, self.received = folder / "requests.log", folder / "received.txt"
        self.asked: list[tuple[str, str]] = []
        self.sizes: list[int] = []
        self.initial: str | None = None
        self.end: str | None = None
        whole = self.path.read_bytes() if self.path.exists() else b""
        whole = whole[: whole.rfind(b"\n") + 1]  # a line that was cut off was never sent
        for number, line in enumerate(whole.decode("ascii", errors="replace").splitlines(), start=1):
            self._take_up(number, line.split("\t"), ["trial", url, trial])
        self._check_received()
        self._lines, self._rows = self.path.open("ab"), self.received.open("ab")
        self._lines.truncate(len(whole))
        self._rows.truncate(self.sizes[-1] if self.sizes else 0)
        if not whole:
            self._write("trial", url, trial)

    @property
    def pending(self) -> tuple[str, str] | None:
        """Label and position of the request that was not answered, if there is one."""
        return self.asked[-1] if len(self.asked) > len(self.sizes) else None

    def note_initial(self, position: str) -> None:
        """Where the trial begins, as the server said before the first request; afterwards it says something else."""
        self._write("initial", position)
        self.initial = position

    def ask(self, label: str, position: str) -> None:
        """Before a request is sent."""
        self._write("ask", label, f"{time.time():.3f}", position)
        self.asked.append((label, position))

    def got(self, body: bytes) -> None:
        """Keep the rows of the last request, byte by byte."""
        self._rows.write(body if not body or body.endswith(b"\n") else body + b"\n")
        self._rows.flush()
        self.sizes.append(self._rows.tell())
        self._write("got", self.asked[-1][0], str(self.sizes[-1]))

    def note_end(self, state: str) -> None:
        """When the server says that the trial is over."""
        self._write("end", state)
        self.end = state

    def slots(self) -> Iterator[str]:
        """The rows that each request got, again."""
        with self.received.open("rb") as file:
            for before, after in zip([0, *self.sizes], self.sizes, strict=False):
                yield file.read(after - before).decode("ascii", errors="replace")

    def close(self) -> None:
        """Let go of the files."""
        self._lines.close()
        self._rows.close()

    def _write(self, *cells: str) -> None:
        line = "\t".join(" ".join(cell.split()) for cell in cells)
        self._lines.write(line.encode("ascii", errors="replace") + b"\n")
        self._lines.flush()

    def _take_up(self, number: int, cells: list[str], first: list[str]) -> None:
        if (number == 1) != (cells == first):
            found = " ".join(cells)
            raise InputError(self.path, f"line {number}", found, f"{' '.join(first)}: a folder for each trial")
        try:
            if cells[0] == "initial":
                self.initial = cells[1]
            elif cells[0] == "ask":
                self.asked.append((cells[1], cells[3]))
            elif cells[0] == "got":
                self.sizes.append(int(cells[2]))
            elif cells[0] == "end":
                self.end = cells[1]
        except (ValueError, IndexError):
            raise InputError(self.path, f"line {number}", "\t".join(cells), "a line as pdr-graph writes it") from None

    def _check_received(self) -> None:
        """The rows must be those that the log tells of."""
        there = self.received.stat().st_size if self.received.exists() else 0
        told = self.sizes[-1] if self.sizes else 0
        if there < told or len(self.sizes) > len(self.asked) or self.sizes != sorted(self.sizes):
            raise InputError(self.received, "", f"{there} bytes", f"the {told} of which {self.path.name} tells")
