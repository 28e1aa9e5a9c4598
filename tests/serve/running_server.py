"""`pdr-graph serve` in a process, on a free port."""

import json
import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request

from plans import ROOT
from streamed_walks import PATIENCE, until

SERVE = "from pdr_graph.apps.cli import main; main()"


def certificate(file):
    """The command that makes a certificate for this machine, as docs/app.md has it."""
    [line] = [line for line in (ROOT / "docs" / "app.md").read_text().splitlines() if line.startswith("openssl req")]
    return line.replace("192.168.1.7", "127.0.0.1").replace("serve.pem", str(file)).split()


class RunningServer:
    """A server whose output is a file beside its folder. before: Python code that runs first."""

    def __init__(self, folder, *options, before=""):
        self.output = folder.with_name(f"{folder.name}.txt")
        self.command = [sys.executable, "-c", before + SERVE, "serve", "--out", str(folder), *options]
        self.start()

    def start(self, port=0):
        with self.output.open("w") as output:
            streams = {"stdout": output, "stderr": subprocess.STDOUT}
            command = [*self.command, "--port", str(port)]
            self.process = subprocess.Popen(command, **streams, start_new_session=True)
        until(lambda: "Push URL" in self.printed() or self.process.poll() is not None)
        assert self.process.poll() is None, self.printed()
        self.port = int(self.printed().splitlines()[0].split(":")[-1].split("/")[0])
        scheme = "https" if "--certificate" in self.command else "http"
        self.url = f"{scheme}://127.0.0.1:{self.port}"

    def printed(self):
        """All that the server printed."""
        return self.output.read_text(encoding="utf-8")

    def kill(self):
        """End all its processes at once, if it runs."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait(PATIENCE)

    def estimators(self):
        """The numbers of the processes that estimate."""
        command = ["ps", "-o", "pid=,args=", "--ppid", str(self.process.pid)]
        found = subprocess.run(command, capture_output=True, text=True, check=True)
        return [int(line.split()[0]) for line in found.stdout.splitlines() if "spawn_main" in line]

    def post(self, *bodies, path="/sensorlogger"):
        """The status of the last answer."""
        for body in bodies:
            status = self.ask(path, body)[0]
        return status

    def ask(self, path, body=None, method=None):
        """Status and text of an answer."""
        try:
            request = urllib.request.Request(self.url + path, body, method=method)
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def walkers(self):
        return json.loads(self.ask("/walkers")[1])

    def published(self, count):
        """The pose of the first walker when so many messages were used."""
        return until(lambda: next((pose for pose in self.walkers() if pose["message"] >= count), None))

    def connected(self):
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE)
        connection.settimeout(PATIENCE)
        return connection
