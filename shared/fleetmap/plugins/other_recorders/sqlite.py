"""Opens rosbag2 recordings in SQLite: a .db3 file, or a folder with the files of one recording, with or without metadata.yaml.

Files may be hostile. They are opened read-only, restricted to their own tables, values are limited to the size of a message, and rows are
read in the order of their ids, without sorting or unpacking. rosbags' reader does none of this, needs metadata.yaml,
and cannot read a single message again. Source of the layout: rosbag2_storage_sqlite3.
"""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path

from fleetmap.errors import RecordingError
from fleetmap.plugins.other_recorders.decoders import AnyEncoding
from fleetmap.plugins.other_recorders.streams import open_messages
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.files import file_head, natural_key, what_file_instead
from fleetmap.recordings.limits import MAX_MESSAGE_BYTES, unpack_message
from fleetmap.recordings.mcap.streams import Channel, Message, Place

_MAGIC = b"SQLite format 3\0"
_PACKED = ".db3.zstd"
_TOPICS = "SELECT id, name, type, serialization_format FROM topics"
_MESSAGES = "SELECT rowid, topic_id, timestamp, data FROM messages"


def recognises(path: Path) -> bool:
    """True for an SQLite file, or a folder with .db3 files, also compressed ones."""
    if path.is_dir():
        return any(path.glob("*.db3")) or any(path.glob(f"*{_PACKED}"))
    return path.is_file() and (path.name.endswith((".db3", _PACKED)) or file_head(path, len(_MAGIC)) == _MAGIC)


def open_sqlite(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a rosbag2 .db3 file, or in a folder of several."""
    files = [path]
    if path.is_dir():
        files = sorted([*path.glob("*.db3"), *path.glob(f"*{_PACKED}")], key=lambda file: natural_key(file.name))
    for file in files:
        if file.name.endswith(_PACKED):
            raise RecordingError(f"{file} is compressed as a whole; unpack it with `zstd -d {file}`")
    return open_messages(path, "rosbag2-sqlite", partial(SqliteFiles, tuple(files)), options)


class SqliteFiles(AnyEncoding):
    """Open .db3 files of one recording, in the order of their names, as a Container. A place: number of the file, row, 0."""

    def __init__(self, files: Sequence[Path]) -> None:
        super().__init__(files)
        with ExitStack() as opened:
            self._databases = [opened.enter_context(_opened(file)) for file in files]
            self._files = opened.pop_all()

    def messages(self) -> Iterator[Message]:
        """See Container: in the order of rows, which is the order of writing."""
        channels: dict[tuple[str, str, str], Channel] = {}
        for number, (file, database) in enumerate(zip(self.files, self._databases, strict=True)):
            if file.with_name(f"{file.name}-wal").exists():
                how = f"`sqlite3 {file} 'PRAGMA wal_checkpoint'` merges them"
                self.note("the recorder was stopped hard", f"messages in {file.name}-wal are not read; {how}")
            try:
                topics = {}
                for key, *names in database.execute(_TOPICS):
                    topic, kind, encoding = (str(name) for name in names)
                    self.keep(len(topic) + len(kind))
                    new = Channel(len(channels), topic, encoding, kind.replace("/msg/", "/"))
                    topics[key] = channels.setdefault((topic, kind, encoding), new)
                yield from self._rows(number, topics)
            except (sqlite3.Error, UnicodeDecodeError) as error:
                too_big = f"a value is too big, {MAX_MESSAGE_BYTES} bytes are the limit; "
                fault = too_big if "too big" in str(error) else ""
                self.note(f"{file.name} is damaged", f"{fault}what follows is not read; {_recovery(file)}")

    def _rows(self, number: int, topics: Mapping[object, Channel]) -> Iterator[Message]:
        odd = 0
        for row, topic, stamp_ns, data in self._databases[number].execute(f"{_MESSAGES} ORDER BY rowid"):
            self.pass_record()  # pages that form a cycle have more rows, and more bytes, than the file
            channel = topics.get(topic)
            if channel is None or not isinstance(stamp_ns, int) or not isinstance(data, bytes):
                odd += 1
                continue
            try:
                stored = memoryview(self.unpack("", data))
                yield channel, stamp_ns, (number, row, 0), unpack_message(stored, self.unpack)
            except ValueError:
                odd += 1
        if odd:
            self.note(f"{self.files[number].name}: damaged messages", f"{odd} rows left out")

    def read(self, place: Place) -> bytes:
        number, row, _ = place
        file = self.files[number]
        try:
            found = self._databases[number].execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
        except sqlite3.Error as error:
            fault = f"row {row} cannot be read; it is damaged, or was changed while it was read"
            raise RecordingError(f"{file}: {fault}. {_recovery(file)}") from error
        if found is None or not isinstance(found[0], bytes):
            raise RecordingError(f"{file}: row {row} is gone; is it still being written?")
        return bytes(unpack_message(memoryview(found[0])))

    def close(self) -> None:
        self._files.close()


@contextmanager
def _opened(file: Path) -> Iterator[sqlite3.Connection]:
    """Open a connection that writes nothing, not even beside the file; RecordingError for anything but a recording."""
    if file_head(file, len(_MAGIC)) != _MAGIC:
        fault = what_file_instead(file) or "not an SQLite database; copy the recording again"
        raise RecordingError(f"{file} is {fault}")
    # Used by one thread at a time, but not always by the one that opened it
    name = f"{file.absolute().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(name, uri=True, check_same_thread=False)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        try:
            database.execute("PRAGMA trusted_schema = OFF")
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not {"topics", "messages"} <= tables:
                found = ", ".join(sorted(str(name) for name in tables)[:5]) or "nothing"
                fault = f"not a rosbag2 recording: it holds {found[:200]}"
                raise RecordingError(f"{file} is an SQLite database, but {fault}")
            for question in (_TOPICS, _MESSAGES):
                database.execute(f"{question} LIMIT 0")
        except (sqlite3.Error, UnicodeDecodeError) as error:
            lacks = "no such column" in str(error)
            fault = "no such columns as rosbag2's in its tables" if lacks else "damaged or cut off"
            raise RecordingError(f"{file} cannot be read ({fault}); {_recovery(file)}") from error
        yield database


def _recovery(file: Path) -> str:
    return f"save what is whole with `sqlite3 {file} .recover | sqlite3 saved.db3`"


FORMAT = RecordingFormat("a rosbag2 .db3 file, or its folder", recognises, open_sqlite, (".db3",), 1)
