"""One attack of ``hostile_files.py``: its files, what the program should do, and honest files beside it."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from recorders import phyphox, sample

REFUSED, USED = (2,), (0, 3)
EITHER = (0, 2, 3)


@dataclass(frozen=True)
class Attack:
    """make: writes the files into a folder and returns the arguments of ``pdr-graph``, in which OUT/ is the folder for
    results, and the size of the input in bytes once unpacked; codes: allowed exit codes; says: a pattern that must be
    in what is printed or in the warnings of ``summary.json``.
    """

    name: str
    make: Callable[[Path], tuple[list, int]]
    codes: tuple[int, ...] = REFUSED
    says: str = ""


@cache
def honest():
    """The files of a short walk, as phyphox writes them."""
    return phyphox(sample())


def walk(folder):
    """The path of an honest recording."""
    target = folder / "walk"
    for name, text in honest().items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_text(text)
    return target
