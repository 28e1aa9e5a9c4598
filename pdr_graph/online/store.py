"""The file of a journal: its tables, and the settings that it was made with."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from pdr_graph import database
from pdr_graph.database import Kind
from pdr_graph.errors import InputError
from pdr_graph.online.codec import decode, pack, unpack

JOURNAL = Kind("journal", 0x50445247, 1)  # "PDRG", and of this form of file
SCHEMA = (
    "CREATE TABLE setting (name TEXT PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE event (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",
    "CREATE TABLE snapshot (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",  # the state after that event
    "CREATE TABLE trajectory (number INTEGER PRIMARY KEY, bytes BLOB NOT NULL)",  # the rows that settled by then
)


def open_store(path: Path, settings: Mapping[str, Any], synchronous: str) -> tuple[sqlite3.Connection, dict[str, Any]]:
    """The database, and the settings that it was made with: these, if it is new.

    Raises InputError if the file is something else, of a newer version, damaged or in use; OSError of the disk.
    """
    rows = [(name, pack(value)) for name, value in settings.items()]
    opened = database.create_or_open(path, JOURNAL, SCHEMA, {"INSERT INTO setting VALUES (?, ?)": rows})
    try:
        with explained(path):
            opened.execute("PRAGMA wal_autocheckpoint = 0")  # but after each snapshot
            opened.execute(f"PRAGMA synchronous = {synchronous}")
            said = opened.execute("PRAGMA quick_check(1)").fetchone()[0]
            if said != "ok":
                raise sqlite3.DatabaseError(said)
            rows = opened.execute("SELECT name, bytes FROM setting").fetchall()
        return opened, {name: read(path, f"setting {name}", blob) for name, blob in rows}
    except BaseException:
        opened.close()
        raise


def read(path: Path, place: str, blob: bytes, kinds: tuple[type, ...] = ()) -> Any:
    """What bytes of the file say: an event or a trajectory of these kinds, or a snapshot or setting."""
    try:
        return decode(blob, kinds) if kinds else unpack(blob)
    except ValueError as error:
        raise InputError(path, place, str(error), "a journal that is whole") from None


def explained(path: Path) -> AbstractContextManager[None]:
    """What SQLite says of a journal, as this package says it."""
    return database.explained(path, JOURNAL)
