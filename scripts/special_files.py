#!/usr/bin/env python3
"""Give every file option of the command line a pipe, a device, a socket or a folder: each ends with one line.

scripts/special_files.py [WORD …]     only cases whose command has one of the words
"""

import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LIMIT, MEMORY = 60.0, 2 << 30  # [s] and [bytes] of a command
PROGRAM = [sys.executable, "-c", "from pdr_graph.apps.cli import main; main()"]
COMMANDS = [  # @ is the special file
    "smooth @ --out o",
    "smooth sim --map @ --out o",
    "smooth sim --fixes @ --out o",
    "smooth sim --walker @ --out o",
    "smooth sim --beacons @ --out o",
    "smooth sim --ranges @ --out o",
    "smooth sim --radio-map @ --out o",
    "smooth sim --truth @ --out o",
    "smooth holding --out o",
    "replay sim --fixes @ --out o",
    "replay sim --journal @ --out o",
    "radio-map @ sim --out o.npz",
    "steps @ --out o.csv",
    "steps sim --walker @ --out o.csv",
    "calibrate sim --route @ --out w.toml",
    "evaluate @ sim/truth.csv",
    "evaluate sim/truth.csv @",
    "evaluate sim/truth.csv sim/truth.csv --map @",
    "simulate @ --out o",
    "map check @",
    "map show @ --out o.png",
    "map convert @ --out o.geojson",
    "lifelog add days.db @",
    "lifelog add @ sim",
    "lifelog add days.db sim --map @",
    "lifelog import days.db @",
    "lifelog build @",
    "lifelog show @",
    "lifelog export @ --out o",
    "lifelog serve @ --port 0",
    "serve --map @ --port 0 --out s",
    "serve --walker @ --port 0 --out s",
    "serve --beacons @ --port 0 --out s",
    "serve --radio-map @ --port 0 --out s",
    "evaal http://127.0.0.1:1/evaalapi/ t --map @ --out o",
]


def special_files(folder):
    """Paths by kind."""
    os.mkfifo(folder / "pipe")
    unix = socket.socket(socket.AF_UNIX)
    unix.bind(str(folder / "socket"))
    holding = folder / "holding"  # a recording with a pipe in it
    holding.mkdir()
    for file in (folder / "sim").glob("*.csv"):
        if file.name in ("Accelerometer.csv", "TotalAcceleration.csv", "Gravity.csv", "Metadata.csv"):
            (holding / file.name).write_bytes(file.read_bytes())
    os.mkfifo(holding / "Gyroscope.csv")
    _, terminal = os.openpty()
    return {
        "pipe": "pipe",
        "zeros": "/dev/zero",
        "terminal": os.ttyname(terminal),
        "socket": "socket",
        "folder": "holding",
    }


def attacked(command, path, folder):
    """Exit code (None: killed after LIMIT), seconds, peak [MB] and last line of standard error."""
    arguments = [path if word == "@" else word for word in command.split()]

    def limited():
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

    started = time.monotonic()
    process = subprocess.Popen(
        [*PROGRAM, *arguments],
        cwd=folder,
        preexec_fn=limited,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        _, said = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        _, said = process.communicate()
        return None, LIMIT, "killed", said.decode("utf-8", "replace").splitlines()
    return process.returncode, time.monotonic() - started, "", said.decode("utf-8", "replace").splitlines()


def main():
    words, bad, count = sys.argv[1:], 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([*PROGRAM, "simulate", "arcade", "--out", "sim"], cwd=folder, check=True, capture_output=True)
        specials = special_files(folder)
        for command in COMMANDS:
            if words and not any(word in command for word in words):
                continue
            for kind, path in specials.items() if "@" in command else [("pipe in a folder", "")]:
                code, seconds, note, lines = attacked(command, path, folder)
                well = code is not None and not any("Traceback" in line for line in lines)
                well &= (code == 2 and len(lines) == 1) or kind.endswith("folder")
                bad, count = bad + (not well), count + 1
                line = lines[-1][:150] if lines else ""
                mark = "ok " if well else "BAD"
                print(f"{mark} {command:45} {kind:9} {code} {seconds:5.1f} s {note} {line}", flush=True)
    print(f"{count - bad} of {count} ended with exit code 2 and one line")
    return bad > 0


if __name__ == "__main__":
    sys.exit(main())
