"""Study webhooks against a stand-in for Sensor Logger's cloud."""

import asyncio
import contextlib
import json
import threading
import urllib.parse
from contextlib import contextmanager

import pytest
import recorders
from stand_in_server import QuietHandler, served

from pdr_graph.apps.serve import study
from pdr_graph.apps.serve.study import MOST_LISTED, StudyReports, Upload, plain, refusal, report, upload_of
from pdr_graph.errors import InputError

pytestmark = pytest.mark.timeout(60)
PATIENCE = 30.0  # [s] for a report
UPLOAD = Upload("studyone", "upload-7", "s3cr3t")


class Cloud:
    """recording: the file of the upload; faults: statuses of the next answers; reports: what was posted."""

    def __init__(self, recording):
        self.recording, self.faults, self.reports, self.calls = recording, [], [], []
        self.reported, self.elsewhere, self.accepts = threading.Event(), None, "POST"

    def answer(self, method, path, query, headers, body):
        self.calls.append((method, path))
        if self.faults:
            return self.faults.pop(0), b""
        if headers.get("Authorization") != UPLOAD.secretCode:
            return 401, b""
        if query != {"studyId": UPLOAD.studyId, "uploadId": UPLOAD.uploadId}:
            return 404, b""
        if method == "GET" and path == "/api/study/file/v1":
            return 200, self.recording
        if path == "/api/study/webhook/v1":
            if method != self.accepts:
                return 405, b""
            self.reports.append((headers["Content-Type"], body.decode()))
            self.reported.set()
            return 200, b""
        return 404, b""


@contextmanager
def serving(cloud):
    class Handler(QuietHandler):
        def _do(self):
            parts = urllib.parse.urlsplit(self.path)
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            if cloud.elsewhere and self.command == "GET":
                self.send_response(302)
                self.send_header("Location", cloud.elsewhere)
                self.end_headers()
                return
            query = dict(urllib.parse.parse_qsl(parts.query))
            status, content = cloud.answer(self.command, parts.path, query, self.headers, body)
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = do_PUT = _do  # noqa: N815

    with served(Handler) as server:
        yield f"http://127.0.0.1:{server.server_port}/api"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A walk as the app exports it, zipped."""
    folder = tmp_path_factory.mktemp("study")
    recorders.in_zip(folder / "walk.zip", recorders.sensor_logger(recorders.sample()))
    return (folder / "walk.zip").read_bytes()


@pytest.fixture
def refusing(monkeypatch):
    """An estimate that refuses its recording at once."""
    script = "import sys; print('recording: found no zip, expected one', file=sys.stderr); sys.exit(2)"
    monkeypatch.setattr(study, "SMOOTH", script)


def reported(tmp_path, cloud, upload=UPLOAD, **more):
    """Run the reports until the cloud has one, or no upload waits any more; returns what was said."""
    said = []

    async def until():
        with serving(cloud) as api:
            reports = StudyReports(tmp_path / "study", ["studyone"], say=said.append, api=api, pause=0.01, **more)
            if upload is not None:
                reports.accept(upload)
            running = asyncio.create_task(reports.run())
            async with asyncio.timeout(PATIENCE):
                while reports._pending():
                    await asyncio.sleep(0.02)
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running

    asyncio.run(until())
    return said


def test_an_upload_is_fetched_smoothed_and_reported(tmp_path, recording):
    cloud = Cloud(recording)
    reported(tmp_path, cloud)
    ((kind, text),) = cloud.reports
    assert kind == "text/markdown"
    assert text.startswith("# Your walk")
    assert "| distance | 2" in text, "21 m"
    assert list((tmp_path / "study").iterdir()) == []


def test_a_recording_that_cannot_be_used_is_reported_in_one_line(tmp_path):
    cloud = Cloud(b"this is no zip")
    reported(tmp_path, cloud)
    ((_, text),) = cloud.reports
    assert "could not be reconstructed" in text
    assert "expected" in text
    assert "/tmp" not in text.replace(str(tmp_path), "/tmp"), "no path of the server"


def test_an_upload_outlives_the_process(tmp_path, refusing):
    cloud = Cloud(b"this is no zip")
    StudyReports(tmp_path / "study", ["studyone"]).accept(UPLOAD)
    (file,) = (tmp_path / "study").iterdir()
    assert file.stat().st_mode & 0o077 == 0, "it holds the code"
    reported(tmp_path, cloud, upload=None)
    assert len(cloud.reports) == 1


def test_a_cloud_that_fails_is_asked_again(tmp_path, refusing):
    cloud = Cloud(b"this is no zip")
    cloud.faults = [503, 500]
    said = reported(tmp_path, cloud)
    assert len(cloud.reports) == 1
    assert "attempt 2" in said[0]


def test_a_cloud_that_refuses_is_not(tmp_path):
    cloud = Cloud(b"")
    cloud.faults = [403]
    assert "403" in reported(tmp_path, cloud)[0]
    assert len(cloud.calls) == 1


def test_a_cloud_that_accepts_put_alone_gets_put(tmp_path, refusing):
    cloud = Cloud(b"this is no zip")
    cloud.accepts = "PUT"
    reported(tmp_path, cloud)
    assert len(cloud.reports) == 1


def test_the_code_follows_no_redirect_to_another_host(tmp_path, refusing):
    storage, cloud = Cloud(b"no"), Cloud(b"no")
    seen = []
    storage.answer = lambda method, path, query, headers, body: (
        seen.append(headers.get("Authorization")) or 200,
        b"no",
    )
    with serving(storage) as elsewhere:
        cloud.elsewhere = elsewhere
        reported(tmp_path, cloud)
    assert seen == [None]


def test_an_estimate_that_hangs_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "SMOOTH", "import time; time.sleep(60)")
    monkeypatch.setattr(study, "SMOOTHING_TIMEOUT", 0.5)
    cloud = Cloud(b"this is no zip")
    reported(tmp_path, cloud)
    assert "took more than" in cloud.reports[0][1]


def test_an_estimate_that_crashes_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "SMOOTH", "import os; os.abort()")
    cloud = Cloud(b"this is no zip")
    said = reported(tmp_path, cloud)
    assert "the estimate failed" in cloud.reports[0][1]
    assert "ended with" in said[0]


def test_an_upload_of_another_study_is_refused(tmp_path):
    reports = StudyReports(tmp_path, ["studyone"])
    with pytest.raises(InputError, match="another study"):
        reports.accept(Upload("other", "u", "s"))
    StudyReports(tmp_path, [study.ANY]).accept(Upload("other", "u", "s"))


def test_more_uploads_than_can_wait_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "MOST_PENDING", 1)
    reports = StudyReports(tmp_path, ["studyone"])
    reports.accept(UPLOAD)
    with pytest.raises(OSError, match="waiting"):
        reports.accept(Upload("studyone", "another", "s"))


@pytest.mark.parametrize(
    "body",
    [b"", b"[]", b'{"studyId": "a"}', b'{"studyId": 1, "uploadId": "b", "secretCode": "c"}', b"\xff"]
    + [json.dumps({"studyId": "a", "uploadId": text, "secretCode": "c"}).encode() for text in ("", "x" * 300, "a\nb")],
)
def test_other_bodies_are_one_line(body):
    with pytest.raises(InputError, match="webhook"):
        upload_of(body)


def test_the_code_is_in_no_message():
    assert "s3cr3t" not in repr(UPLOAD)


def test_a_report_is_one_page_and_its_text_has_no_meaning_in_markdown():
    summary = {
        "verdict": {"state": "doubtful", "reasons": [{"text": "<b>GNSS</b> | against *steps*", "check": "the fixes"}]},
        "duration": 125.0, "steps": 100, "distance": 70.0, "floors": ["1", "2"], "fixes": [{"weight": 0.0}],
        "protection": None, "missing": [], "warnings": [f"note {n}" for n in range(30)],
        "versions": {"pdr_graph": "1"},
    }  # fmt: skip
    text = report(summary)
    assert "<b>" not in text
    assert "\\| against" in text
    assert text.count("- note") == MOST_LISTED
    assert f"and {30 - MOST_LISTED} lines more" in text
    assert "2 min 5 s" in text
    assert "1 → 2" in text


def test_a_refusal_is_plain():
    assert refusal("a_b <script>").endswith("a\\_b \\<script\\>\n")
    assert plain("x\ny") == "x y"
