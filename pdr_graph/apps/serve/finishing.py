"""The recording of a finished session: a zip as Sensor Logger exports it, or a GPX track."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TextIO

import numpy as np

from pdr_graph.apps.serve import positions, sensor_messages
from pdr_graph.apps.serve.access import OWNER
from pdr_graph.apps.serve.live_walk import LOG, RECORDINGS, Session, read_session
from pdr_graph.apps.serve.sensor_messages import SENSOR_LOGGER, USED_COLUMNS
from pdr_graph.errors import InputError, count
from pdr_graph.io import gpx
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.io.writers import cell
from pdr_graph.online.journal import read_body, read_entries

COLUMNS = {**USED_COLUMNS, "bluetooth": ("id", "rssi")}  # name in a message: columns of its table


def write_recording(folder: Path) -> Path:
    """Write the recording of a session into its folder, from its log; returns the file.

    Raises InputError if the log is damaged or has no samples; OSError of the disk.
    """
    session = read_session(folder)
    target = folder / RECORDINGS[0 if session.protocol == SENSOR_LOGGER else 1]
    new = target.with_name(f"new-{target.name}")
    new.unlink(missing_ok=True)
    new.touch(mode=0o600)
    write = _write_export if session.protocol == SENSOR_LOGGER else _write_track
    write(new, folder, session)
    new.replace(target)
    return target


def _messages(folder: Path, ordered: bool) -> Iterator[bytes]:
    """The messages of a log, by their identity or as they came."""
    entries = list(read_entries(folder / LOG))
    for entry in sorted(entries, key=lambda entry: entry.identity) if ordered else entries:
        yield read_body(folder / LOG, entry)


def _write_export(file: Path, folder: Path, session: Session) -> None:
    """Write tables as the app does, in its units and signs, as the numbers came."""
    signs, start = sensor_messages.Signs(), 0
    with TemporaryDirectory(dir=folder) as scratch, ExitStack() as files:
        tables = dict[str, TextIO]()
        for body in _messages(folder, ordered=True):
            try:
                message = sensor_messages.parse(body)
            except InputError:
                continue
            if not signs.acceleration:  # as the live walk decided
                columns, _ = sensor_messages.tables_of(message.payload)
                android = any(sample.accuracy is not None for sample in message.payload)
                sensor_messages.signals_of(columns, signs, session.platform, android)
            for sample in sorted(message.payload, key=lambda sample: sample.time):
                name, time = sample.name.lower(), int(sample.time)
                if name not in COLUMNS:
                    continue
                start = start or time
                if name not in tables:  # as the app names it: AccelerometerUncalibrated.csv
                    title = f"{name.capitalize().replace('uncalibrated', 'Uncalibrated')}.csv"
                    tables[name] = files.enter_context((Path(scratch) / title).open("w", encoding="utf-8"))
                    tables[name].write(f"time,seconds_elapsed,{','.join(COLUMNS[name])}\n")
                cells = ",".join(_cell(getattr(sample.values, column)) for column in COLUMNS[name])
                tables[name].write(f"{time},{(time - start) * sensor_messages.NANOSECOND:.6f},{cells}\n")
        if not tables:
            raise InputError(folder, "", "no samples", "a session with samples")
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for table in tables.values():
                table.flush()
                archive.write(table.name, Path(table.name).name)
            if signs.acceleration:
                platform = "ios" if signs.acceleration < 0 else "android"
                archive.writestr("Metadata.csv", f"platform,recording epoch time\n{platform},{start // 10**6}\n")


def _cell(value: Any) -> str:
    """A value as a cell of a CSV; empty for what is neither text nor number."""
    return cell(value) if isinstance(value, str) else repr(value) if isinstance(value, int | float) else ""


def _write_track(file: Path, folder: Path, session: Session) -> None:
    """Write the positions as GPX, with their accuracies."""
    fixes = [positions.parse(session.protocol, body)[1] for body in _messages(folder, ordered=False)]
    rows = np.concatenate([np.column_stack([part.time, part.position, part.sigma]) for part in fixes])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    points = gpx.Points(rows[:, 1:3], rows[:, 0], RADIUS_68 * rows[:, 3])
    file.write_bytes(gpx.document([gpx.Track(session.name, (points,))]))


def finish(folder: Path, store: Path | None, plan: Path | None) -> str:
    """Write the recording of a session, and add it to a lifelog, whose day is reconstructed; returns an issue, or "".

    Runs in a process of its own.
    """
    from pdr_graph.apps.lifelog.build import build
    from pdr_graph.apps.lifelog.ingest import DEFAULT_PERSON, add
    from pdr_graph.apps.lifelog.store import RecordingOptions

    try:
        file, user = write_recording(folder), read_session(folder).user
        if store is not None:
            person = DEFAULT_PERSON if user == OWNER else user
            added = add(store, [file], RecordingOptions(plan=plan), person=person, copy=True)
            if added.refused:
                raise InputError(store, "", added.refused[0], "a recording that the lifelog takes")
            build(store)
        damaged = sum(entry.skipped for entry in read_entries(folder / LOG))
    except (InputError, OSError) as error:
        return f"the recording could not be completed: {error}"
    return f"{count(damaged, 'byte')} of {LOG} are damaged: not in the recording" if damaged else ""
