"""Opens rosbag2 recordings in SQLite: a .db3 file, or a folder with the files of one recording, with or without metadata.yaml.

Files may be hostile. They are opened read-only and by their own tables alone, no value is longer than a message may be, and rows are
taken in the order of their ids, so that nothing is sorted or unpacked on the way. Source of the layout: rosbag2_storage_sqlite3.
"""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import zstandard

from fleetmap.errors import RecordingError
from fleetmap.recordings.bags.container import MAX_MESSAGE_BYTES, Channel, KeptBytes, Message, Place, Schema
from fleetmap.recordings.bags.streams import open_messages
from fleetmap.recordings.folders.table_files import natural_key
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.recordings.strange_files import what_file_instead
from fleetmap.sensors.samples import DataIssue

_MAGIC, _ZSTD = b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_SUFFIX, _PACKED = ".db3", ".db3.zstd"
_ROW_BYTES = (
    4  # fewer are no row; a table whose pages refer to each other in a circle has more rows than its file has bytes
)


def recognises(path: Path) -> bool:
    """Whether `path` is an SQLite file, or a folder with .db3 files, packed ones too."""
    if path.is_dir():
        return any(path.glob(f"*{_SUFFIX}")) or any(path.glob(f"*{_PACKED}"))
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return path.name.endswith((_SUFFIX, _PACKED)) or file.read(len(_MAGIC)) == _MAGIC


def open_sqlite(path: Path, options: OpenOptions) -> Recording:
    """The recording in a rosbag2 .db3 file, or in the folder of several."""
    files = sorted(path.glob(f"*{_SUFFIX}"), key=lambda file: natural_key(file.name)) if path.is_dir() else [path]
    packed = [*path.glob(f"*{_PACKED}")] if path.is_dir() else [f for f in files if f.name.endswith(_PACKED)]
    if packed:
        raise RecordingError(f"{packed[0]} is compressed as a whole; unpack it with `zstd -d {packed[0]}`")
    return open_messages(path, "rosbag2-sqlite", partial(SqliteFiles, tuple(files)), options)


class SqliteFiles(KeptBytes):
    """Open .db3 files of one recording, in the order of their names, as a Container. A place: number of the file, row, 0."""

    def __init__(self, files: Sequence[Path]) -> None:
        super().__init__(files[0], sum(file.stat().st_size for file in files))
        self.files = files
        self.name = ""
        self.attachments: Mapping[str, bytes] = {}
        self._issues: list[DataIssue] = []
        self._databases: list[sqlite3.Connection] = []
        try:
            for file in files:
                self._databases.append(_opened(file))
        except BaseException:
            self.close()
            raise

    def messages(self) -> Iterator[Message]:
        """See Container: in the order of rows, which is that of writing."""
        channels: dict[tuple[str, str, str], Channel] = {}
        for number, (file, database) in enumerate(zip(self.files, self._databases, strict=True)):
            if file.with_name(f"{file.name}-wal").exists():
                how = f"`sqlite3 {file} 'PRAGMA wal_checkpoint'` takes them in"
                self._issues.append(
                    DataIssue("the recorder was stopped hard", f"messages in {file.name}-wal are not read; {how}")
                )
            try:
                topics = {}
                for key, *names in database.execute("SELECT id, name, type, serialization_format FROM topics"):
                    topic, kind, encoding = (str(name) for name in names)
                    self.keep(len(topic) + len(kind))
                    new = Channel(len(channels), topic, encoding, Schema(kind))
                    topics[key] = channels.setdefault((topic, kind, encoding), new)
                yield from self._rows(number, topics)
            except (sqlite3.Error, UnicodeDecodeError) as error:
                fault = (
                    f"a value is too big, {MAX_MESSAGE_BYTES} bytes are the limit; " if "too big" in str(error) else ""
                )
                detail = f"{fault}what follows is not read; {_recovery(file)}"
                self._issues.append(DataIssue(f"{file.name} is damaged", detail))

    def _rows(self, number: int, topics: Mapping[object, Channel]) -> Iterator[Message]:
        odd = 0
        rows = self._databases[number].execute("SELECT rowid, topic_id, timestamp, data FROM messages ORDER BY rowid")
        for count, (row, topic, stamp_ns, data) in enumerate(rows):
            if count * _ROW_BYTES > self.size:
                raise RecordingError(
                    f"{self.files[number]} has more rows than bytes; it is damaged. {_recovery(self.files[number])}"
                )
            channel = topics.get(topic)
            if channel is None or not isinstance(stamp_ns, int) or not isinstance(data, bytes):
                odd += 1
                continue
            try:
                yield channel, stamp_ns, (number, row, 0), memoryview(_unpacked(data))
            except ValueError:
                odd += 1
        if odd:
            self._issues.append(DataIssue(f"{self.files[number].name}: damaged messages", f"{odd} rows left out"))

    def issues(self) -> list[DataIssue]:
        return self._issues

    def read(self, place: Place) -> bytes:
        number, row, _ = place
        try:
            found = self._databases[number].execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
        except sqlite3.Error as error:
            raise RecordingError(
                f"{self.files[number]}: row {row} cannot be read; it is damaged, or was changed while it was read. "
                f"{_recovery(self.files[number])}"
            ) from error
        if found is None or not isinstance(found[0], bytes):
            raise RecordingError(f"{self.files[number]}: row {row} is gone; is it still being written?")
        return _unpacked(found[0])

    def close(self) -> None:
        for database in self._databases:
            database.close()


def _opened(file: Path) -> sqlite3.Connection:
    """A connection that writes nothing, not even beside the file; RecordingError for what is no recording."""
    with file.open("rb") as opened:
        if opened.read(len(_MAGIC)) != _MAGIC:
            fault = what_file_instead(file) or "no SQLite database; copy the recording again"
            raise RecordingError(f"{file} is {fault}")
    # Used by one thread at a time, but not always by that which opened it
    database = sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
    database.text_factory = lambda text: text.decode("utf-8", "replace")
    try:
        database.execute("PRAGMA trusted_schema = OFF")
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            found = ", ".join(sorted(str(name) for name in tables)[:5]) or "nothing"
            raise RecordingError(f"{file} is an SQLite database, but no rosbag2 recording: it holds {found[:200]}")
        for question in (
            "SELECT id, name, type, serialization_format FROM topics LIMIT 0",
            "SELECT rowid, topic_id, timestamp, data FROM messages LIMIT 0",
        ):
            database.execute(question)
    except (sqlite3.Error, UnicodeDecodeError) as error:
        database.close()
        lacks = "no such column" in str(error)
        fault = "no such columns as rosbag2's in its tables" if lacks else "damaged or cut off"
        raise RecordingError(f"{file} cannot be read ({fault}); {_recovery(file)}") from error
    except BaseException:
        database.close()
        raise
    return database


def _recovery(file: Path) -> str:
    return f"save what is whole with `sqlite3 {file} .recover | sqlite3 saved.db3`"


def _unpacked(data: bytes) -> bytes:
    """A message, of recordings that are compressed message by message too; ValueError where it cannot be unpacked."""
    if not data.startswith(_ZSTD):  # CDR begins with 0
        return data
    try:
        with zstandard.ZstdDecompressor(max_window_size=MAX_MESSAGE_BYTES).stream_reader(data) as reader:
            unpacked = bytes(reader.read(MAX_MESSAGE_BYTES + 1))
    except zstandard.ZstdError as error:
        raise ValueError("it cannot be unpacked") from error
    if len(unpacked) > MAX_MESSAGE_BYTES:
        raise ValueError(f"it unpacks to more than {MAX_MESSAGE_BYTES} bytes")
    return unpacked
