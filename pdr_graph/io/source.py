"""The files of a recording or a plan: one file, a folder or a zip.

Files are untrusted. Archives are read member by member up to a limit on the unpacked bytes, regardless of the sizes in
their directory; members with names that lead outside the archive are refused.
"""

from __future__ import annotations

import gzip
import lzma
import os
import stat
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO, cast

from pdr_graph.errors import InputError, check_not_special, count
from pdr_graph.types import OneLineRepr

MAXIMUM_FILES = 1000
MOST_LINES = 20_000_000  # of a file: ten hours at 400 Hz are 14 million
LIMIT = "PDR_GRAPH_MAX_MB"  # environment variable: maximum size of the text of one recording [MB]
ZIP_METHODS = {zipfile.ZIP_STORED: "stored", zipfile.ZIP_DEFLATED: "deflated"}  # unpacked piece by piece, unlike others
OTHER_METHODS = {zipfile.ZIP_BZIP2: "bzip2", zipfile.ZIP_LZMA: "lzma"}
GZIP, GZIP_MAGIC = ".gz", b"\x1f\x8b"
ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    OSError,
    RuntimeError,
    ValueError,
    OverflowError,
)


class Source(OneLineRepr):
    """The files of a recording or a plan.

    path: the user's argument; names: of the files in it, with ``/`` between folders, without a common top folder.
    """

    def __init__(
        self,
        path: Path,
        subject: str = "recording",
        limit: int | None = None,
        most_files: int = MAXIMUM_FILES,
        deepest: int = 3,
    ):
        """Raises InputError if the path does not exist, or is a damaged or hostile archive.

        subject: what the files are, for messages; limit: on their total size [bytes], by default that of a recording;
        most_files, deepest: largest number of files, and of levels of folders that are searched.
        """
        self.path = path
        self._limit = self._left = limit or _limit()
        self._fewer = (
            f"fewer for a {subject}" if limit else f"fewer (the environment variable {LIMIT} raises the limit)"
        )
        if not path.exists():
            raise InputError(path, "", "no such file", f"a {subject}")
        check_not_special(path, f"a {subject}")
        self._zip = _open_zip(path, most_files)
        if self._zip is not None:
            entries = _zip_entries(path, self._zip)
        elif path.is_dir():
            entries = _folder_entries(path, most_files, deepest)
        else:
            entries = {path.name: path.name}
        if len(entries) > most_files:
            raise InputError(path, "", f"more than {most_files} files", f"the files of one {subject}")
        entries = _without_top_folder(entries)
        self._entries = {_unpacked_name(name, entries): entry for name, entry in entries.items()}

    def _summary(self) -> list[str]:
        return [repr(str(self.path)), count(len(self._entries), "file")]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all files, sorted."""
        return tuple(sorted(self._entries))

    @property
    def single(self) -> str | None:
        """The name of the only file; None if there are several."""
        return self.names[0] if len(self._entries) == 1 else None

    def where(self, name: str) -> str:
        """The name of a file for messages."""
        return str(self.path) if self._zip is None and self.path.is_file() else f"{self.path}/{name}"

    def named(self, *names: str) -> str | None:
        """The first file with one of these names, in any folder and case; None if there is none.

        Raises InputError if a name occurs twice: two recordings were packed together.
        """
        for name in names:
            matches = [n for n in self.names if PurePosixPath(n).name.lower() == name.lower()]
            if len(matches) > 1:
                raise InputError(self.path, "", f"two files {matches[0]} and {matches[1]}", "one recording at a time")
            if matches:
                return matches[0]
        return None

    def head(self, name: str, size: int = 4096) -> bytes:
        """The first `size` bytes of a file, without a byte-order mark of UTF-8."""
        return self._read(name, size)[:size].removeprefix(b"\xef\xbb\xbf")

    def content(self, name: str) -> bytes:
        """A whole file. Raises InputError if all files together exceed the limit, whatever the archive states."""
        data = self._inflated(name) or self._read(name, self._left + 1)
        self._left -= len(data)
        if self._left < 0:
            found = f"more than {self._limit // 10**6} MB of files"
            raise InputError(self.where(name), "", found, self._fewer)
        return data

    def text(self, name: str, errors: str = "strict") -> str:
        """A whole file as text: UTF-8, or UTF-16 with its byte-order mark, as spreadsheets save it.

        Raises InputError for other bytes, and for more than MOST_LINES, each of which takes some 200 bytes of memory.
        """
        return self.utf8(name, errors).decode()

    def utf8(self, name: str, errors: str = "strict") -> bytes:
        """A whole file as UTF-8, without a byte-order mark. Raises InputError as `text`; takes half its memory."""
        data = self.content(name)
        if (lines := data.count(b"\n")) > MOST_LINES:
            raise InputError(self.where(name), "", f"{lines} lines", f"at most {MOST_LINES}: a shorter recording")
        if data.isascii():
            return data
        encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
        try:
            return data.decode(encoding, errors).encode()
        except UnicodeDecodeError as error:
            raise InputError(self.where(name), f"byte {error.start}", "bytes that are not UTF-8", "text") from None

    def size(self, name: str) -> int:
        """The size of a file [bytes], as the archive states it."""
        entry = self._entries[name]
        return self._file(entry).stat().st_size if self._zip is None else self._zip.getinfo(entry).file_size

    @contextmanager
    def stream(self, name: str) -> Iterator[IO[bytes]]:
        """A file opened for reading. Raises InputError where an archive cannot be unpacked."""
        entry = self._entries[name]
        if self._zip is None:
            with self._file(entry).open("rb") as stream, self._unpacking(name, stream) as unpacked:
                yield unpacked
            return
        try:
            with self._zip.open(entry) as stream, self._unpacking(name, stream) as unpacked:
                yield unpacked
        except InputError:
            raise
        except ZIP_ERRORS as error:
            found = f"an archive member that cannot be unpacked ({error})"
            raise InputError(self.where(name), "", found, "an undamaged zip without a password") from None

    @contextmanager
    def _unpacking(self, name: str, stream: IO[bytes]) -> Iterator[IO[bytes]]:
        """A file, or what is packed in it by gzip. Raises InputError where that is damaged."""
        if self._entries[name].lower().endswith(GZIP) and stream.read(2) == GZIP_MAGIC:
            stream.seek(0)
            try:
                with gzip.open(stream) as unpacked:
                    yield cast("IO[bytes]", unpacked)
            except (gzip.BadGzipFile, EOFError, zlib.error) as error:
                found = f"a damaged gzip file ({error})"
                raise InputError(self.where(name), "", found, "a whole file: was the download cut off?") from None
        else:
            stream.seek(0)
            yield stream

    def _file(self, entry: str) -> Path:
        """The path of a file that is not in an archive."""
        return self.path / entry if self.path.is_dir() else self.path

    def _read(self, name: str, size: int) -> bytes:
        with self.stream(name) as stream:
            return stream.read(size)

    def _inflated(self, name: str) -> bytes | None:
        """A whole member of an archive by ISA-L, three times as fast as by zlib.

        None without ISA-L, and for whatever is not an undamaged member within the limit: `stream` says what it is.
        """
        member = self._zip.getinfo(self._entries[name]) if self._zip is not None else None
        if member is None or member.compress_type != zipfile.ZIP_DEFLATED or not 0 < member.file_size <= self._left:
            return None
        if member.filename.lower().endswith(GZIP):
            return None
        try:
            from isal import isal_zlib
        except ImportError:
            return None
        with self.stream(name), self.path.open("rb") as file:  # opened as a stream, it has been checked
            # 26 bytes of a member's header come before the lengths of its name and of its extra field
            file.seek(member.header_offset + 26)
            name_size, extra_size = (int.from_bytes(file.read(2), "little") for _ in range(2))
            file.seek(name_size + extra_size, os.SEEK_CUR)
            packed = file.read(member.compress_size)
        inflater = isal_zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            data = inflater.decompress(packed, member.file_size + 1)
        except isal_zlib.error:  # pyright: ignore[reportGeneralTypeIssues] the stub has an instance
            return None
        return data if len(data) == member.file_size and isal_zlib.crc32(data) == member.CRC else None


def _limit() -> int:
    """The maximum size of the text of one recording [bytes]: 1 GB by default, a day of three sensors at 100 Hz."""
    limit = os.environ.get(LIMIT, "1000")
    if not limit.isdecimal() or int(limit) == 0:
        raise InputError(LIMIT, "", repr(limit), "a number of megabytes")
    return int(limit) * 10**6


class _BoundedReads:
    """A file of an archive for reading its directory alone, which is refused before it is read if it is too long."""

    def __init__(self, file: BinaryIO, path: Path, most_files: int):
        self._file, self._path, self._most_files = file, path, most_files
        self.seek, self.tell = file.seek, file.tell

    def read(self, size: int = -1) -> bytes:
        """The next bytes. Raises InputError for more than the directory of so many files has."""
        # 300 bytes of the directory for each file: twice what a file of an app has
        if size > max(300 * self._most_files, 1 << 20):
            found = f"a directory of {size / 1e6:.1f} MB"
            raise InputError(self._path, "", found, f"an archive of at most {self._most_files} files")
        return self._file.read(size)


def is_zip(path: Path) -> bool:
    """True for a zip archive, whatever its name."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(4) in (b"PK\x03\x04", b"PK\x05\x06")


def _open_zip(path: Path, most_files: int) -> zipfile.ZipFile | None:
    """The open archive; None if the file is not a zip."""
    if not is_zip(path):
        return None
    try:
        with path.open("rb") as file:
            zipfile.ZipFile(cast("BinaryIO", _BoundedReads(file, path, most_files))).close()
        return zipfile.ZipFile(path)
    except InputError:
        raise
    except ZIP_ERRORS as error:
        raise InputError(path, "", f"a damaged zip ({error})", "a complete zip: was the download cut off?") from None


def _zip_entries(path: Path, archive: zipfile.ZipFile) -> dict[str, str]:
    """Member names by file name; raises InputError if a member is a link, leads elsewhere or occurs twice."""
    entries: dict[str, str] = {}
    for info in archive.infolist():
        parts = PurePosixPath(info.filename.replace("\\", "/")).parts
        if _is_clutter(parts) or info.is_dir():
            continue
        is_link = stat.S_ISLNK(info.external_attr >> 16)
        if is_link or ".." in parts or parts[0].startswith("/") or ":" in parts[0]:
            found = f"a member {'link' if is_link else 'name'} that leads elsewhere, {info.filename[:60]!r}"
            raise InputError(path, "", found, "an archive of plain files")
        if info.compress_type not in ZIP_METHODS:
            method = OTHER_METHODS.get(info.compress_type, f"method {info.compress_type}")
            found = f"{info.filename[:60]!r} packed by {method}"
            raise InputError(
                path, "", found, f"an archive whose files are {' or '.join(ZIP_METHODS.values())}: pack it again"
            )
        name = "/".join(parts)
        if name in entries:
            raise InputError(path, "", f"two members named {name[:60]!r}", "an archive with each file once")
        entries[name] = info.filename
    return entries


def _folder_entries(folder: Path, most_files: int, deepest: int) -> dict[str, str]:
    """The regular files in a folder, down to `deepest` levels; links to folders are not followed.

    Raises InputError for a link to a file elsewhere, whose content would be in results that are passed on.
    """
    entries: dict[str, str] = {}
    root = folder.resolve()
    for top, folders, files in os.walk(folder):
        inside = Path(top).relative_to(folder)
        if len(inside.parts) >= deepest or len(entries) > most_files:
            folders.clear()
        for file in files:
            name = inside / file
            if not _is_clutter(name.parts) and (folder / name).is_file():
                if (folder / name).is_symlink() and not (folder / name).resolve().is_relative_to(root):
                    found = f"a link that leads elsewhere, {name.as_posix()[:60]!r}"
                    raise InputError(folder, "", found, "a folder of plain files: copy it with cp -rL")
                entries[name.as_posix()] = str(name)
    return entries


def _unpacked_name(name: str, others: Collection[str]) -> str:
    """The name of what a file has, ``walk.gpx`` of ``walk.gpx.gz``; its own where another file has that name."""
    inner = name[: -len(GZIP)] if name.lower().endswith(GZIP) else name
    return name if inner in others else inner


CLUTTER = ("__MACOSX", ".DS_Store", "Thumbs.db")  # what operating systems add to folders and zips


def _is_clutter(parts: tuple[str, ...]) -> bool:
    return not parts or any(part in CLUTTER or part.startswith("._") for part in parts)


def _without_top_folder(entries: dict[str, str]) -> dict[str, str]:
    """The entries with the folder removed that is common to all names, if there is one."""
    tops = {name.split("/")[0] for name in entries}
    if len(tops) == 1 and all("/" in name for name in entries):
        return {name.split("/", 1)[1]: entry for name, entry in entries.items()}
    return entries
