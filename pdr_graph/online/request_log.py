"""What a client of a competition asked for and what it got, on disk, so that one that was killed goes on.

``requests.log`` has a line for each request before it is sent and one when its rows are safe in ``received.txt``::

    trial<TAB>URL<TAB>TRIAL        initial<TAB>POSITION
    ask<TAB>LABEL<TAB>UNIX TIME<TAB>POSITION        got<TAB>LABEL<TAB>BYTES OF received.txt
    end<TAB>STATE

A request without its ``got`` is sent again under the same label, and the server repeats its answer.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from pdr_graph.errors import InputError

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
