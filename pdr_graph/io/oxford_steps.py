"""Recordings of the Oxford step counter data set: an accelerometer alone, without a header.

Either a file ``t_ns,ax,ay,az,…`` of the validation set, or a folder with an ``accelerometer.csv`` of
``t_ns,accuracy,ax,ay,az``. Times are nanoseconds since the phone booted.
"""

from __future__ import annotations

import re

import numpy as np

from pdr_graph.errors import count
from pdr_graph.io.delimited import TextRows
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording
from pdr_graph.types import Recording

NAME = "Oxford step counter"
# The first row of a file of the validation set, and of a file with the accuracy of each sample
NUMBER_BYTES = rb"-?[0-9.]+(?:[eE][+-]?[0-9]+)?"
VALIDATION = re.compile(rb"^[0-9]{9,19}(?:," + NUMBER_BYTES + rb"){3}(?:,[0-9]+){3}\r?\n")
WITH_ACCURACY = re.compile(rb"^[0-9]{9,19},[0-3](?:," + NUMBER_BYTES + rb"){3}\r?\n")


def recognizes(source: Source) -> bool:
    """True if the first row is of one of the two forms."""
    name = _accelerometer(source)
    return name is not None and bool(re.match(VALIDATION.pattern + b"|" + WITH_ACCURACY.pattern, source.head(name)))


def read(source: Source) -> Recording:
    """Read one recording. Leading rows of zeros, from before the phone's filter started, are left out."""
    name = _accelerometer(source) or ""
    first = 2 if WITH_ACCURACY.match(source.head(name)) else 1
    rows = TextRows(source.where(name), source.utf8(name)).floats((0, first, first + 1, first + 2))
    started = np.cumsum(np.any(rows[:, 1:] != 0, axis=1)) > 0
    rows = rows[started] * (1e-9, 1, 1, 1)
    zeros = count(int((~started).sum()), "row")
    notes = [f"accelerometer: {zeros} of zeros at the start left out"] if not started.all() else []
    return build_recording(source.where(name), source.path.stem, {"accelerometer": rows}, None, notes=notes)


def _accelerometer(source: Source) -> str | None:
    return source.single or source.named("accelerometer.csv")
