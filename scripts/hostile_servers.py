#!/usr/bin/env python3
"""Attack each client of the program as a server that it asks: how it ends, when, and how much memory it took.

scripts/hostile_servers.py [--client evaal] [--jobs 4] [WORD …]      only attacks with one of the words
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hostile_server import ATTACKS, attacking, body

LIMIT = 400.0  # [s] after which a client hangs
SHORT = (
    "import pdr_graph.apps.evaal.client as c; c.SILENCE, c.LONGEST_CALL = 2.0, 10.0; "  # the same with smaller limits
)
SHORT_STUDY = "import pdr_graph.apps.serve.study as s; s.DOWNLOAD = 20.0\n"
MAIN = "from pdr_graph.apps.cli import main; main()"
ROWS = "".join(f"ACCE;{1 + n / 100:.3f};{1 + n / 100:.3f};0.1;0.2;9.8;3\n" for n in range(50)).encode()
STATE = b"1.0,-1,1.0,20.0,0.0,0.5,1.0,0.0;0.0;0"
GOOD_ANSWERS = 3  # requests for rows before the attack on them
STUDY = """
import asyncio, sys; from pathlib import Path; from pdr_graph.apps.serve.study import *
upload = Upload("study", "upload", "code")
try: asyncio.run(fetch(sys.argv[1], upload, Path("recording.zip")))
except CloudError as error: print(error, file=sys.stderr); sys.exit(2)
"""
PHONE = """
import asyncio, sys; from pdr_graph.apps.serve.pulling import *
try: list(messages_of(asyncio.run(PhyphoxPhone(sys.argv[1]).poll()), 0))
except PhoneError as error: print(error, file=sys.stderr); sys.exit(2)
"""
TILES = """
import sys; import numpy as np; from pdr_graph.apps.lifelog.maps import *
try: list(tiles(sys.argv[1], MercatorFrame(48.0, 11.0), np.array([[-500.0, -500.0], [500.0, 500.0]]), 1500))
except OSError as error: print(error, file=sys.stderr); sys.exit(2)
"""


def trial(attack, at):
    """Answers of a competition's server, which attacks at a call: state, rows or log."""
    asked = []

    def answer(path):
        call = path.split("/")[-1].split("?")[0]
        if call == at == "state" or call == at == "log":
            return attack
        if call == "state":
            return body(STATE)
        if call == "nextdata":
            asked.append(path)
            if len(asked) <= GOOD_ANSWERS:
                return body(ROWS)
            return attack if at == "nextdata" else over
        return body(b"")

    def over(client, host):
        text = STATE.replace(b"-1", b"0.0")
        client.sendall(b"HTTP/1.1 405 Over\r\nContent-Length: %d\r\n\r\n" % len(text) + text)

    return answer


CLIENTS = {  # answers of the server, and the client's arguments by its address
    "evaal, state": (
        lambda attack: trial(attack, "state"),
        lambda host: [MAIN, "evaal", f"http://{host}/evaalapi/", "t", "--out", "o"],
    ),
    "evaal, rows": (
        lambda attack: trial(attack, "nextdata"),
        lambda host: [MAIN, "evaal", f"http://{host}/evaalapi/", "t", "--out", "o"],
    ),
    "evaal, log": (
        lambda attack: trial(attack, "log"),
        lambda host: [MAIN, "evaal", f"http://{host}/evaalapi/", "t", "--out", "o"],
    ),
    "study": (lambda attack: lambda path: attack, lambda host: [STUDY, f"http://{host}/api"]),
    "phyphox": (lambda attack: lambda path: attack, lambda host: [PHONE, f"http://{host}"]),
    "tiles": (lambda attack: lambda path: attack, lambda host: [TILES, f"http://{host}/{{z}}/{{x}}/{{y}}.png"]),
}


def attacked(client, name):
    """Exit code (None: it hangs), seconds, peak [MB], lines on standard error, whether the trial's log was kept."""
    answers, arguments = CLIENTS[client]
    with tempfile.TemporaryDirectory() as folder, attacking(answers(ATTACKS[name])) as (host, _):
        said = Path(folder) / "said"
        started, limit = time.monotonic(), time.monotonic() + LIMIT
        with said.open("wb") as file:
            command = [sys.executable, "-c", *arguments(host)]
            process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=file)
            while True:
                done, status, usage = os.wait4(process.pid, os.WNOHANG)
                if done:
                    break
                if time.monotonic() > limit:
                    process.kill()
                    os.wait4(process.pid, 0)
                    return None, LIMIT, 0.0, [], False
                time.sleep(0.05)
        process.returncode = os.waitstatus_to_exitcode(status)
        lines = said.read_text("utf-8", "replace").splitlines()
        log = Path(folder) / "o" / "requests.log"
        kept = log.read_text().count("got\t") if log.exists() else 0
        return process.returncode, time.monotonic() - started, usage.ru_maxrss / 1000, lines, kept


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--client", default="")
    parser.add_argument("--jobs", type=int, default=4)
    parser.add_argument(
        "--short", action="store_true", help="evaal: 2 s of silence, 10 s a call; study: 20 s a recording"
    )
    parser.add_argument("words", nargs="*")
    options = parser.parse_args()
    if options.short:
        globals().update(MAIN=SHORT + MAIN, STUDY=SHORT_STUDY + STUDY)
    cases = [
        (client, name)
        for client in CLIENTS
        for name in ATTACKS
        if options.client in client and (not options.words or any(word in name for word in options.words))
    ]
    bad = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        for (client, name), result in zip(cases, pool.map(lambda case: attacked(*case), cases), strict=True):
            code, seconds, peak, lines, kept = result
            well = code is not None and not any("Traceback" in line for line in lines)
            well &= (code in (2, 3) and bool(lines)) or name in FINE.get(client, ())
            well &= client != "evaal, rows" or kept >= GOOD_ANSWERS
            bad += not well
            mark = "ok " if well else "BAD"
            line = lines[0][:140] if lines else ""
            print(f"{mark} {client:12} {name:44} {code} {seconds:6.1f} s {peak:5.0f} MB {line}", flush=True)
    print(f"{len(cases) - bad} of {len(cases)} ended within {LIMIT:.0f} s with one line and exit code 2 or 3")
    return bad > 0


FINE = {  # answers that are as good as any other
    "evaal, log": tuple(ATTACKS),  # without the server's log nothing is missing
    "study": (  # a file that `smooth` refuses then
        "random bytes",
        "an empty answer",
        "a bomb of gzip",
        "a length too short",
        "two lengths",
        "JSON nested 10^5 deep",
        "JSON of NaN",
        "a state of NaN",
        "control characters",
    ),
}


if __name__ == "__main__":
    sys.exit(main())
