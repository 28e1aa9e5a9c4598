"""A client of the EvAAL API, with which competitions send sensor rows and receive positions; a log of all requests.

The server is untrusted and may be slow, unreachable or faulty. Each call for data advances the trial, so that a
repeated call would lose rows. `Api.next_data` therefore repeats a call under the same label, for which the server sends
the same rows. `Api.all_data` is never repeated, since a second call ends an offline trial.

With the log, a killed client can resume. ``requests.log`` has a line for each request, written before it is sent, and
another when its rows are saved in ``received.txt``::

    trial<TAB>URL<TAB>TRIAL        initial<TAB>POSITION
    ask<TAB>LABEL<TAB>UNIX TIME<TAB>POSITION        got<TAB>LABEL<TAB>BYTES OF received.txt
    end<TAB>STATE

A request without ``got`` is sent again under the same label, and the server repeats its answer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, urlsplit

from pdr_graph import InputError
from pdr_graph.web_request import REDIRECTS, TooLongError, ask
from pdr_graph.whole_files import lock

# Status codes of HTTP, as the EvAAL API uses them
GOOD, CREATED = 200, 201
SOME_REJECTED, UNKNOWN_TRIAL, OVER, TOO_EARLY = 409, 404, 405, 423
RETRIED = (TOO_EARLY, 429, 502, 503, 504)  # too early, or a server that is unavailable for now

NOT_BEGUN, NOT_BEGUN_OFFLINE = -1.0, -2.0  # time left of a trial before its first call
CSV_TYPE = "text/csv; charset=us-ascii"  # the only content type that the server accepts
TRIES, FIRST_PAUSE = 10, 0.05  # of one call; [s] after the first try, doubled each time: 26 s in all
SILENCE, LONGEST_CALL = 10.0, 120.0  # [s] without a byte; of one call with all its tries, without the pauses
# [bytes] of the rows of one request, some hundred times those of a phone; of a state; of a whole trial; of its log
MAXIMUM_REQUEST, MAXIMUM_TEXT, MAXIMUM_DATA, MAXIMUM_LOG = 4_000_000, 100_000, 1_000_000_000, 100_000_000


class UnreachableError(OSError):
    """The server did not answer in any of the tries."""


@dataclass(frozen=True)
class State:
    """The state of a trial on the server: ``trialts,rem,V,S,p,h,pts,pos``.

    time: up to which rows were sent [s]; left: rest of the trial [s], negative before the first call; speed: trial time
    per real time [-]; slack: time until the timeout [s]; position: the last one received, before that the initial one.
    """

    time: float
    left: float
    speed: float
    slack: float
    position: str
    text: str

    @classmethod
    def parse(cls, text: str) -> State | None:
        """A state from its text; None if the text is not a state. The position may contain commas."""
        fields = text.strip().split(",", 7)
        try:
            ts, left, speed, slack, _, _, _ = (float(field) for field in fields[:7])
        except ValueError:
            return None
        if not all(map(math.isfinite, (ts, left, speed, slack))):
            return None
        return cls(ts, left, speed, slack, fields[7].strip() if len(fields) > 7 else "", text.strip())

    @property
    def offline(self) -> bool:
        """True for an offline trial before its first call; later its state does not show it."""
        return self.left == NOT_BEGUN_OFFLINE

    @property
    def begun(self) -> bool:
        """True if rows were sent already."""
        return self.left not in (NOT_BEGUN, NOT_BEGUN_OFFLINE)

    @property
    def timed_out(self) -> bool:
        """For a trial that is over: True if it ended by timeout, with rows left or without slack."""
        return self.left > 0 or self.slack < 0


@dataclass(frozen=True)
class Reply:
    """An answer of the server. seconds: from the first try to the answer [s]; tries: their number."""

    code: int
    body: bytes
    seconds: float
    tries: int

    @property
    def text(self) -> str:
        """The body as ASCII; other bytes are replaced by a mark."""
        return self.body.decode("ascii", errors="replace")


class Api:
    """One trial of one server."""

    def __init__(self, url: str, trial: str, sleep: Callable[[float], None] = time.sleep):
        """Raises InputError unless the URL is an http or https URL. sleep: waits for a number of seconds."""
        try:
            parts = urlsplit(url)
            valid = parts.scheme in ("http", "https") and bool(parts.hostname) and url.isascii() and url.isprintable()
        except ValueError:
            valid = False
        if not valid or not trial:
            raise InputError("the server", "", f"{url!r} and trial {trial!r}", "http://…/evaalapi/ and a trial's name")
        self.url, self.trial = url.rstrip("/") + "/", trial
        self._base, self._sleep = self.url + quote(trial, safe="") + "/", sleep

    def state(self, tries: int = TRIES) -> State:
        """The state of the trial. Raises InputError if there is no such trial or no such server."""
        try:
            reply = self._ask("state", tries=tries)
        except UnreachableError as error:
            raise InputError(self.url, self.trial, str(error), "a server of the EvAAL API") from None
        state = State.parse(reply.text) if reply.code in (GOOD, OVER) else None
        if state is None:
            raise self.unexpected(reply)
        return state

    def next_data(self, label: str, position: str, horizon: float) -> Reply:
        """Request the rows of the next ``horizon`` [s], or 405 at the end.

        position: the estimate for the time before these rows, "" for none; label: if the server had it already, it
        repeats its answer. Raises UnreachableError.
        """
        query = f"nextdata?horizon={horizon:g}&label={quote(label, safe='')}"
        return self._ask(query + (f"&position={quote(position, safe=',;')}" if position else ""), most=MAXIMUM_REQUEST)

    def all_data(self) -> Reply:
        """Request all rows of an offline trial, which the server sends once. Raises UnreachableError."""
        return self._ask("nextdata?offline", most=MAXIMUM_DATA, tries=1)

    def post_estimates(self, lines: str) -> Reply:
        """Send ``time,position`` lines of an offline trial; 201 if all were accepted. Raises UnreachableError."""
        return self._ask("estimates", lines.encode("ascii"))

    def log(self) -> bytes:
        """The server's log of the trial; empty if it sends none."""
        try:
            reply = self._ask("log", most=MAXIMUM_LOG, tries=1)
        except (UnreachableError, InputError):
            return b""
        return reply.body if reply.code == GOOD else b""

    def unexpected(self, reply: Reply) -> InputError:
        """The error to raise for an unexpected answer."""
        found = f"{reply.code} {reply.text[:200].strip()!r}" if reply.body else f"{reply.code}"
        expected = {
            UNKNOWN_TRIAL: "the base URL, which ends in /evaalapi/, and the trial's name as the organisers gave them",
            OVER: "a trial that has not ended",
        }
        if reply.code in REDIRECTS:
            return InputError(self.url, self.trial, f"a redirect {reply.text[:200]}", "the URL to which it leads")
        return InputError(self.url, self.trial, found, expected.get(reply.code, "an answer of the EvAAL API"))

    def _ask(self, query: str, data: bytes | None = None, most: int = MAXIMUM_TEXT, tries: int = TRIES) -> Reply:
        """One call, repeated while the server does not answer or asks to retry. Raises UnreachableError."""
        started, found, made = time.monotonic(), "", 0
        method, headers = ("POST", {"Content-Type": CSV_TYPE}) if data else ("GET", {})
        for made in range(1, tries + 1):
            left = started + LONGEST_CALL - time.monotonic()
            try:  # codes 4xx are answers, too: the normal end of a trial is one
                answer = ask(self._base + query, SILENCE, left, most, method=method, body=data, headers=headers)
            except TooLongError as error:
                raise InputError(self.url, self.trial, str(error), "one of the EvAAL API") from None
            except OSError as error:
                found = f"no answer ({error})"
            else:
                body = f"to {answer.location}".encode() if answer.status in REDIRECTS else answer.body
                if answer.status not in RETRIED:
                    return Reply(answer.status, body, time.monotonic() - started, made)
                found = f"{answer.status} {body[:100]!r}"
            if made < tries:
                self._sleep(FIRST_PAUSE * 2 ** (made - 1))
            if time.monotonic() > started + LONGEST_CALL:
                break
        raise UnreachableError(f"{found} after {made} {'try' if made == 1 else 'tries'}")


OFFLINE = "offline"  # the label of the one request of an offline trial


class RequestLog:
    """The log of the requests of one trial, in a folder.

    asked: label and position of each request; sizes: of ``received.txt`` after each answer [bytes]; initial: the
    trial's initial position, None until it is noted; end: the state in which the trial ended, None before.
    """

    def __init__(self, folder: Path, url: str, trial: str):
        """Open or create the log. Raises InputError if it is damaged, in use or that of another trial."""
        folder.mkdir(parents=True, exist_ok=True)
        self.path, self.received = folder / "requests.log", folder / "received.txt"
        self._lines = self.path.open("ab")
        lock(self._lines.fileno(), self.path)
        self.asked: list[tuple[str, str]] = []
        self.sizes: list[int] = []
        self.initial: str | None = None
        self.end: str | None = None
        whole = self.path.read_bytes()
        whole = whole[: whole.rfind(b"\n") + 1]  # the request of an incomplete line was not sent
        for number, line in enumerate(whole.decode("ascii", errors="replace").splitlines(), start=1):
            self._parse_line(number, line.split("\t"), ["trial", url, trial])
        found = self.received.stat().st_size if self.received.exists() else 0
        logged = self.sizes[-1] if self.sizes else 0
        if found < logged or len(self.sizes) > len(self.asked) or self.sizes != sorted(self.sizes):
            raise InputError(self.received, "", f"{found} bytes", f"{logged} bytes as in {self.path.name}")
        self._rows = self.received.open("ab")
        self._lines.truncate(len(whole))
        self._rows.truncate(logged)
        if not whole:
            self._write("trial", url, trial)

    @property
    def pending(self) -> tuple[str, str] | None:
        """Label and position of the request without an answer; None if there is none."""
        return self.asked[-1] if len(self.asked) > len(self.sizes) else None

    def note_initial(self, position: str) -> None:
        """Note the initial position; the server states it before the first request only."""
        self._write("initial", position)
        self.initial = position

    def ask(self, label: str, position: str) -> None:
        """Note a request; call it before sending."""
        self._write("ask", label, f"{time.time():.3f}", position)
        self.asked.append((label, position))

    def got(self, body: bytes) -> None:
        """Save the rows of the last request unchanged."""
        self._rows.write(body)
        if body and not body.endswith(b"\n"):
            self._rows.write(b"\n")
        self._rows.flush()
        self.sizes.append(self._rows.tell())
        self._write("got", self.asked[-1][0], str(self.sizes[-1]))

    def note_end(self, state: str) -> None:
        """Note the state of the server at the end of the trial."""
        self._write("end", state)
        self.end = state

    def slots(self) -> Iterator[str]:
        """The rows of each answered request, as text."""
        with self.received.open("rb") as file:
            for before, after in zip([0, *self.sizes], self.sizes, strict=False):
                yield file.read(after - before).decode("ascii", errors="replace")

    def close(self) -> None:
        """Close the files."""
        self._lines.close()
        self._rows.close()

    def _write(self, *cells: str) -> None:
        """Append a line to the log."""
        line = "\t".join(" ".join(cell.split()) for cell in cells)
        self._lines.write(line.encode("ascii", errors="replace") + b"\n")
        self._lines.flush()

    def _parse_line(self, number: int, cells: list[str], first: list[str]) -> None:
        """Restore the state from a line of the log; the cells of line 1 must be `first`."""
        if (number == 1) != (cells == first):
            found = " ".join(cells)
            raise InputError(self.path, f"line {number}", found, f"{' '.join(first)} (a folder for each trial)")
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
