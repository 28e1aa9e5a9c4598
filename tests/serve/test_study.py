"""Study webhooks against a stand-in for Sensor Logger's cloud."""

import asyncio
import contextlib
import json
import urllib.parse
from contextlib import contextmanager

import pytest
import recorders
from stand_in_server import QuietHandler, served
from streamed_walks import local_server, soon

from pdr_graph.apps.serve import study
from pdr_graph.apps.serve.pulling import Sources
from pdr_graph.apps.serve.study import MOST_LISTED, StudyReports, Upload, plain, refusal, report, upload_of
from pdr_graph.errors import InputError

pytestmark = [pytest.mark.timeout(60), pytest.mark.anyio]
UPLOAD = Upload("studyone", "upload-7", "s3cr3t")
CALL = {"studyId": "mine", "uploadId": "u", "secretCode": "c"}
REFUSING = "import sys; print(f'{sys.argv[2]}: found no zip, expected one', file=sys.stderr); sys.exit(2)"
HANGING, CRASHING = "import time; time.sleep(60)", "import os; os.abort()"


class Cloud:
    """recording: the file of the upload; faults: statuses of the next answers; reports: what was posted; codes: sent
    with each call; elsewhere: address to which downloads are redirected; accepts: method of a report.
    """

    def __init__(self, recording=b"this is no zip", faults=(), elsewhere=None, accepts="POST"):
        self.recording, self.faults, self.reports, self.codes = recording, list(faults), [], []
        self.elsewhere, self.accepts = elsewhere, accepts

    def answer(self, method, path, query, headers, body):
        self.codes.append(headers.get("Authorization"))
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
            assert headers["Content-Type"] == "text/markdown"
            self.reports.append(body.decode())
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


async def reported(tmp_path, cloud, upload=UPLOAD):
    """Run the reports until no upload waits any more; returns what was said."""
    said = []
    with serving(cloud) as api:
        reports = StudyReports(tmp_path / "study", ["studyone"], say=said.append, api=api, pause=0.01)
        if upload is not None:
            reports.accept(upload)
        running = asyncio.create_task(reports.run())
        await soon(lambda: not reports._pending())
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    return said


async def test_an_upload_is_fetched_smoothed_and_reported(tmp_path, recording):
    cloud = Cloud(recording)
    await reported(tmp_path, cloud)
    (text,) = cloud.reports
    assert text.startswith("# Your walk")
    assert "| distance | 2" in text, "21 m"
    assert list((tmp_path / "study").iterdir()) == []


@pytest.mark.parametrize(
    ("script", "report", "cause"),
    [
        (REFUSING, "could not be reconstructed.\n\nrecording: found no zip, expected one\n", "reported"),
        (HANGING, "took more than", "reported"),
        (CRASHING, "the estimate failed", "ended with"),
    ],
    ids=["refuses", "hangs", "crashes"],
)
async def test_an_estimate_without_a_result_is_reported(tmp_path, monkeypatch, script, report, cause):
    monkeypatch.setattr(study, "SMOOTH", script)
    monkeypatch.setattr(study, "SMOOTHING_TIMEOUT", 0.5 if script == HANGING else 30.0)
    cloud = Cloud()
    said = await reported(tmp_path, cloud)
    assert report in cloud.reports[0]
    assert cause in said[0]


async def test_an_upload_outlives_the_process_and_a_cloud_that_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "SMOOTH", REFUSING)
    StudyReports(tmp_path / "study", ["studyone"]).accept(UPLOAD)
    (file,) = (tmp_path / "study").iterdir()
    assert file.stat().st_mode & 0o077 == 0, "it holds the code"
    cloud = Cloud(faults=[503, 500], accepts="PUT")
    assert "attempt 2" in (await reported(tmp_path, cloud, upload=None))[0]
    assert len(cloud.reports) == 1


async def test_a_cloud_that_refuses_is_not_asked_again(tmp_path):
    cloud = Cloud(faults=[403])
    assert "403" in (await reported(tmp_path, cloud))[0]
    assert len(cloud.codes) == 1


async def test_the_code_follows_no_redirect_to_another_host(tmp_path):
    storage = Cloud(faults=[404])
    with serving(storage) as elsewhere:
        await reported(tmp_path, Cloud(elsewhere=elsewhere))
    assert storage.codes == [None]


def test_a_call_is_stored_if_its_study_is_configured_and_there_is_room(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "MOST_PENDING", 1)
    nowhere = "http://127.0.0.1:9/api"
    reports = StudyReports(tmp_path / "study", ["mine"], say=lambda text: None, api=nowhere, pause=60.0)
    for configured, call, status in (
        (None, CALL, 404),
        (reports, CALL | {"studyId": "other"}, 400),
        (reports, "x", 400),
        (reports, CALL, 200),
        (reports, CALL | {"uploadId": "more"}, 507),
    ):
        with local_server(tmp_path, sources=Sources(study=configured)) as client:
            assert client.post("/study", json=call).status_code == status
    assert len(list((tmp_path / "study").glob("*.json"))) == 1, "the cloud could not be reached: it is tried again"
    StudyReports(tmp_path / "any", [study.ANY]).accept(UPLOAD)


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
