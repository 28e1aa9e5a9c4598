"""Study webhooks of Sensor Logger: a recording uploaded to a study is fetched, smoothed, and reported in the app.

Off unless studies are configured. Source: STUDY_WEBHOOKS.md of tszheichoi/awesome-sensor-logger. The cloud calls once
per recording, so that each call is stored before it is answered, and dealt with after a restart too. What is fetched is
deleted when its report was posted. The smoothing runs in a process of its own, which may fail or hang alone.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

import msgspec

from pdr_graph.apps.lifelog.cache import write
from pdr_graph.errors import EXIT_DEGRADED, EXIT_REFUSED, InputError, count, one_line
from pdr_graph.types import DOUBTFUL, OK
from pdr_graph.web_request import TooLongError, request

API = "https://sensorlogger.app/api"
ANY = "any"  # instead of the name of a study: the app's own test of a webhook names another one
MOST_PENDING = 1000  # uploads, each a file of 1 kB
CLOUD_TIMEOUT = 30.0  # [s] for an answer of the cloud to begin or go on
DOWNLOAD, POST = 600.0, 60.0  # [s] for all of a recording; for a report
SMOOTHING_TIMEOUT = 1800.0  # [s] for an estimate
ATTEMPTS, ATTEMPT_PAUSE = 5, 60.0  # to reach the cloud; [s] between two, times their number
SMOOTH = "from pdr_graph.apps.cli import main; main()"
MOST_LISTED = 8  # of each list: the report is one page
SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|~])")
VERDICT_WORDS = {
    OK: "The sources of this walk agree with each other.",
    DOUBTFUL: "**Treat the path with caution**: sources of this walk contradict each other.",
}
NOT_CONSISTENT = "**The path cannot be trusted**: nothing fits together."
# Of an identity: up to 200 printable ASCII characters
Identity = Annotated[str, msgspec.Meta(min_length=1, max_length=200, pattern=r"^[ -~]+\Z")]


class Upload(msgspec.Struct, frozen=True):
    """A recording in the cloud, as the webhook names it; ``secretCode`` gives access to it."""

    studyId: Identity  # noqa: N815
    uploadId: Identity  # noqa: N815
    secretCode: Identity  # noqa: N815

    def __repr__(self) -> str:
        return f"Upload({one_line(self.studyId)[:40]!r}, {one_line(self.uploadId)[:40]!r})"  # without the code

    @property
    def file_name(self) -> str:
        """Name of the file that stores it."""
        return hashlib.sha256(f"{self.studyId}\0{self.uploadId}".encode()).hexdigest()[:32] + ".json"


class CloudError(OSError):
    """The cloud did not answer (again: worth another attempt), or refused (status: of HTTP)."""

    def __init__(self, text: str, again: bool, status: int = 0):
        super().__init__(text)
        self.again, self.status = again, status


def upload_of(body: bytes) -> Upload:
    """Decode a call of the webhook. Raises InputError."""
    try:
        return msgspec.json.decode(body, type=Upload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InputError("webhook", "", one_line(str(error)), "JSON with studyId, uploadId and secretCode") from None


@dataclass
class StudyReports:
    """Uploads that wait for their report.

    folder: of their files; studies: whose uploads are accepted; plan: of the building, if all walks are in one; say:
    called with one line about each upload; api: address of the cloud.
    """

    folder: Path
    studies: Sequence[str]
    plan: Path | None = None
    say: Callable[[str], None] = print
    api: str = API
    pause: float = ATTEMPT_PAUSE
    _changed: asyncio.Event = field(default_factory=asyncio.Event, init=False)

    def accept(self, upload: Upload) -> None:
        """Store an upload, to be reported. Raises InputError for another study; OSError if the disk or it is full."""
        if upload.studyId not in self.studies and ANY not in self.studies:
            raise InputError("webhook", "studyId", "another study", "one that pdr-graph serve --study names")
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if len(self._pending()) >= MOST_PENDING:
            raise OSError(f"{MOST_PENDING} uploads are waiting")
        write(self.folder / upload.file_name, msgspec.json.encode(upload), durable=True)
        self._changed.set()

    async def run(self) -> None:
        """Report all uploads, one after the other, for ever."""
        while True:
            self._changed.clear()
            for file in self._pending():
                await self._report(file)
            await self._changed.wait()

    def _pending(self) -> list[Path]:
        return sorted(self.folder.glob("*.json"), key=lambda file: file.stat().st_mtime)

    async def _report(self, file: Path) -> None:
        """Report one upload; its file is removed at the end, whatever the end was."""
        try:
            upload = upload_of(file.read_bytes())
            await self._repeated(upload)
        except (InputError, CloudError, OSError) as error:
            self.say(f"study: {one_line(str(error))}")
        file.unlink(missing_ok=True)

    async def _repeated(self, upload: Upload) -> None:
        for attempt in range(1, ATTEMPTS + 1):
            try:
                with tempfile.TemporaryDirectory(prefix="pdr-graph-study-") as folder:
                    return await self._once(upload, Path(folder))
            except CloudError as error:
                if not error.again or attempt == ATTEMPTS:
                    raise
                self.say(f"study: {one_line(str(error))}; attempt {attempt + 1} in {attempt * self.pause:.0f} s")
                await asyncio.sleep(attempt * self.pause)

    async def _once(self, upload: Upload, folder: Path) -> None:
        recording = folder / "recording.zip"
        await fetch(self.api, upload, recording)
        text = (await smoothed(recording, folder / "result", self.plan, self.say)).encode()
        try:
            await _ask(self.api, "study/webhook/v1", upload, POST, body=text, method="POST")
        except CloudError as error:
            if error.status != 405:
                raise
            await _ask(
                self.api, "study/webhook/v1", upload, POST, body=text, method="PUT"
            )  # as the app's demonstration
        self.say(f"study: {upload!r} reported")


async def smoothed(recording: Path, out: Path, plan: Path | None, say: Callable[[str], None]) -> str:
    """Smooth a recording in another process; return its report in Markdown. say: called with the cause of a failure."""
    arguments = [sys.executable, "-c", SMOOTH, "smooth", str(recording), "--out", str(out)]
    arguments += ["--map", str(plan)] if plan is not None else []
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *arguments, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.DEVNULL, stderr=pipe
    )
    try:
        async with asyncio.timeout(SMOOTHING_TIMEOUT):
            _, said = await process.communicate()
    except TimeoutError:
        return refusal(f"the estimate took more than {SMOOTHING_TIMEOUT / 60:.0f} minutes")
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode in (0, EXIT_DEGRADED):
        return report(json.loads((out / "summary.json").read_text(encoding="utf-8")))
    lines = said.decode("utf-8", "replace").strip().splitlines()
    if process.returncode == EXIT_REFUSED and lines:
        return refusal(lines[-1].replace(str(recording), "recording"))
    say(f"study: the estimate ended with {process.returncode}: {one_line(lines[-1] if lines else '')}")
    return refusal("the estimate failed; the server's log has the cause")


async def fetch(api: str, upload: Upload, file: Path) -> None:
    """Download a recording. Raises CloudError."""
    with file.open("wb") as out:
        await _ask(api, "study/file/v1", upload, DOWNLOAD, follow="public", out=out)


async def _ask(api: str, path: str, upload: Upload, whole: float, **options: Any) -> None:
    """Ask the cloud, which may redirect to its storage. Raises CloudError, also where the body ends early."""
    address = f"{api}/{path}?{urlencode({'studyId': upload.studyId, 'uploadId': upload.uploadId})}"
    headers = {"Authorization": upload.secretCode} | ({"Content-Type": "text/markdown"} if "body" in options else {})
    most = 2**30  # bytes of a recording; an hour at 100 Hz is 100 MB
    try:
        answer = await request(address, CLOUD_TIMEOUT, whole, most, headers=headers, **options)
    except OSError as error:
        again = not isinstance(error, TooLongError)
        raise CloudError(f"{upload!r}, {path}: {one_line(str(error))}", again) from None
    if not 200 <= answer.status < 300:
        text = f"{upload!r}, {path}: status {answer.status}"
        raise CloudError(text, again=answer.status >= 500, status=answer.status)


# ── the page that a participant gets: one walk in Markdown, from its summary ────────────────────────────────────────


def report(summary: Mapping[str, Any]) -> str:
    """The report of a walk by its ``summary.json``."""
    verdict = summary["verdict"]
    lines = ["# Your walk", "", VERDICT_WORDS.get(verdict["state"], NOT_CONSISTENT), ""]
    lines += ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in _figures(summary)), ""]
    lines += _listed("What contradicts", [f"{each['text']} Check: {each['check']}" for each in verdict["reasons"]])
    lines += _listed("What could not be estimated", summary["missing"])
    lines += _listed("Notes on the recording", summary["warnings"])
    lines.append(f"*pdr\\_graph {plain(summary['versions']['pdr_graph'])}*")
    return "\n".join(lines) + "\n"


def refusal(reason: str) -> str:
    """The report of a recording that cannot be used."""
    return f"# Your walk\n\nThis recording could not be reconstructed.\n\n{plain(reason)}\n"


def plain(text: str) -> str:
    """Untrusted text on one line, without meaning in Markdown."""
    return SPECIAL.sub(r"\\\1", one_line(text))


def _figures(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    minutes, seconds = divmod(round(summary["duration"]), 60)
    yield "duration", f"{minutes} min {seconds} s"
    yield "steps", f"{summary['steps']}"
    yield "distance", f"{summary['distance']:.0f} m"
    if summary["steps"]:
        yield "mean step", f"{summary['distance'] / summary['steps']:.2f} m"
    if len(summary["floors"]) > 1:
        yield "floors", plain(" → ".join(summary["floors"]))
    yield "positions used", f"{sum(fix['weight'] > 0 for fix in summary['fixes'])} of {len(summary['fixes'])}"
    protection = summary.get("protection")
    if protection:
        worst = max(protection["along_95"]["worst"], protection["across_95"]["worst"])
        median = max(protection["along_95"]["median"], protection["across_95"]["median"])
        yield "error with 95 % probability below", f"{median:.1f} m on most of the way, {worst:.1f} m at worst"
    else:
        yield "position", "not known: there is the shape of the walk alone"


def _listed(title: str, lines: list[str]) -> list[str]:
    if not lines:
        return []
    more = len(lines) - MOST_LISTED
    listed = [f"- {plain(line)}" for line in lines[:MOST_LISTED]]
    return [f"## {title}", "", *listed, *([f"- and {count(more, 'line')} more"] if more > 0 else []), ""]
