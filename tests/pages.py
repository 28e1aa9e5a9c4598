"""Pages whose examples are executed: what a reader would type, in the page's order, in one folder.

Blocks of ``sh`` and ``python`` are run, the Python ones of a page in one namespace; ``console`` is shown and not run.
A block of ``text`` right after one is what it says: the same words in the same order, and numbers about as large.
A picture is what its page made: of its own name, or that in a comment ``<!-- made: result/figure.png -->`` before it.

As a program, ``pages.py PAGE …`` runs pages and puts the pictures that they made beside them; ``pages.py --in FOLDER
PAGE`` runs one and leaves what it made there.
"""

import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PICTURE = re.compile(r"(?:<!-- made: (\S+) -->\n)?!\[[^]]*\]\(([^)#]+)\)")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
ABOUT = 0.25  # of a stated number may be otherwise: machines round differently, and a walk branches on that
LAST_DIGITS = 3  # or so many of its last decimal
PATIENCE = 120  # [s] for one block
WINDOW = "1280,800"  # [px] of the browser that photographs a page


@dataclass(frozen=True)
class Block:
    """An example: its language, its text, the line before it, and what the page says that it prints."""

    language: str
    text: str
    line: int
    said: str


def blocks(page):
    """The examples of a page that are executed."""
    text = page.read_text(encoding="utf-8")
    found = [*FENCE.finditer(text), None]
    for this, after in pairwise(found):
        adjacent = after is not None and not text[this.end() : after.start()].strip()
        said = after[2] if adjacent and after[1] == "text" else ""
        if this[1] in ("sh", "python"):
            yield Block(this[1], this[2], text.count("\n", 0, this.start(2)), said)


def execute(page, folder):
    """Run a page in a folder; says which line of it failed, and returns all that was printed."""
    names, heard = {}, []
    for block in blocks(page):
        said = _shell(block, page, folder) if block.language == "sh" else _python(block, page, folder, names)
        _check(block, page, said)
        heard.append(said)
    return "".join(heard)


def execute_apart(page, folder):
    """The same in a process of its own: what went wrong, empty if nothing did."""
    command = [sys.executable, __file__, "--in", str(folder), str(page)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    return done.stderr if done.returncode else ""


def pictures(page):
    """Of each picture that a page shows its path beside the page, and that of what its run made."""
    for made, shown in PICTURE.findall(page.read_text(encoding="utf-8")):
        yield shown, made or shown


def draw(page):
    """Run a page, and put what it made beside it; of an HTML page what a browser shows."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        execute(page, folder)
        for shown, made in pictures(page):
            if made.endswith(".html"):
                _photograph(folder / made, page.parent / shown)
            else:
                shutil.copyfile(folder / made, page.parent / shown)


def _photograph(html, png):
    window = [f"--window-size={WINDOW}", "--hide-scrollbars", "--virtual-time-budget=4000", f"--screenshot={png}"]
    browser = shutil.which("chromium") or shutil.which("google-chrome") or "chromium"
    subprocess.run([browser, "--headless", "--no-sandbox", *window, html.as_uri()], check=True, capture_output=True)


def _shell(block, page, folder):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    command = ["bash", "-euo", "pipefail", "-c", block.text]
    environment = os.environ | {"PATH": path, "COLUMNS": "200"}
    kept = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = subprocess.run(command, text=True, cwd=folder, env=environment, timeout=PATIENCE, **kept)
    assert done.returncode == 0, f"{page.name}, line {block.line}: exit {done.returncode}\n{done.stdout}"
    return done.stdout


def _python(block, page, folder, names):
    """In this process; a traceback shows the page's own lines."""
    code = compile("\n" * block.line + block.text, str(page), "exec")
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as out:
        exec(code, names)
    return out.getvalue()


def _check(block, page, said):
    lines = iter(said.splitlines())
    for stated in block.said.splitlines():
        if stated.strip() not in ("", "…"):
            found = any(alike(stated, line) for line in lines)
            assert found, f"{page.name}, line {block.line}: says {stated!r}, but prints\n{said}"


def alike(stated, line):
    """Whether a line is as stated: the same words, numbers about as large; "…" is anything."""
    form = re.sub(r"\s+", r"\\s+", re.escape(NUMBER.sub("\0", stated.strip())).replace("\\ ", " "))
    form = form.replace("…", ".*").replace("\0", f"({NUMBER.pattern})")
    found = re.fullmatch(form, line.strip())
    return found is not None and all(map(_about, NUMBER.findall(stated), found.groups()))


def _about(stated, found):
    decimals = len(stated.partition(".")[2])
    digits = LAST_DIGITS * 10.0**-decimals if decimals else 0.0
    return abs(float(stated) - float(found)) <= max(ABOUT * abs(float(stated)), digits)


if __name__ == "__main__":
    if sys.argv[1] == "--in":
        execute(Path(sys.argv[3]), Path(sys.argv[2]))
    else:
        for argument in sys.argv[1:]:
            draw(Path(argument))
