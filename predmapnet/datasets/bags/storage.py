"""Files of a ROS 2 bag: the messages that they hold, as far as they can be read."""

from __future__ import annotations

import contextlib
import importlib.util
import shutil
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

from predmapnet.errors import UserError

ENDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
LARGEST_RECORD = 2**30
"""Bytes; no chunk of a recording is larger, so a longer one is damage."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a message that was compressed by itself."""

BytesRead = Callable[[int, int], None]
"""Callback ``read(done, total)``, bytes of the bag."""


class Recorded(NamedTuple):
    """Message of a bag.

    Attributes:
        topic: that it was sent on.
        kind: its type, for example ``sensor_msgs/msg/Image``.
        received: when it was recorded, nanoseconds.
        data: the message, serialised (CDR).
    """

    topic: str
    kind: str
    received: int
    data: bytes


class Bag:
    """A recording: one file, or a folder of them. Its ``metadata.yaml`` is not needed.

    Attributes:
        path: of the file or folder.
        files: that hold messages.
        topics: type of each topic that was met so far.
        counts: messages of each topic that were met so far; of types that were asked for.
        damage: what could not be read, a sentence each.
    """

    def __init__(self, path: Path) -> None:
        """Find the files. Raises UserError: there are none, or the extra ``bags`` is not installed."""
        if not all(importlib.util.find_spec(name) for name in ("mcap", "rosbags")):
            raise UserError("Reading bags needs the extra 'bags': pip install 'predmapnet[bags]'.")
        self.path = path
        found = sorted(path.iterdir()) if path.is_dir() else [path]
        self.files = [file for file in found if file.name.lower().endswith(ENDINGS) and file.is_file()]
        self.topics: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.damage: list[str] = []
        if self.files:
            return
        if not path.exists():
            raise UserError(f"There is no bag {path}.")
        if path.suffix == ".bag" or (path.is_dir() and any(path.glob("*.bag"))):
            raise UserError(
                f"{path} is of ROS 1. Turn it into a ROS 2 bag first: rosbags-convert --src FILE.bag --dst FOLDER "
                "(it came with the extra 'bags')."
            )
        raise UserError(f"{path} is no ROS 2 bag: a file {', '.join(ENDINGS)} or a folder of them is expected.")

    def messages(self, kinds: Collection[str], progress: BytesRead = lambda done, total: None) -> Iterator[Recorded]:
        """Yield the messages of some types, file by file; a file ends where it is cut off or damaged."""
        self.damage.clear()
        self.counts.clear()
        total, before = sum(file.stat().st_size for file in self.files), 0
        for file in self.files:
            size = file.stat().st_size
            read = _mcap_messages if ".mcap" in file.name.lower() else _sqlite_messages
            contents, timeless = 0, 0
            with _opened(file) as stream:
                for message in read(self, file, stream, kinds):
                    if not 0 <= message.received < 2**63:
                        timeless += 1
                        continue
                    self.counts[message.topic] += 1
                    contents += len(message.data)
                    progress(before + min(max(contents, stream.tell()), size), total)
                    yield message._replace(data=_plain(message.data))
            if timeless:
                self.damage.append(f"{file.name}: {timeless} messages of a time that no clock has are lost")
            before += size
            progress(before, total)

    def listed_topics(self) -> str:
        """Return the topics with their types, for messages."""
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.topics.items())) or "none"


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[IO[bytes]]:
    """Open a file; ``tell`` tells where in the file on disk it is read."""
    import zstandard

    with file.open("rb") as stream:
        if file.suffix.lower() != ".zstd":
            yield stream
            return
        with zstandard.open(stream, "rb", closefd=False) as plain:
            yield plain


def _plain(data: bytes) -> bytes:
    """Return a message that was compressed by itself as it was; a damaged one is not told from others here."""
    import zstandard

    with contextlib.suppress(zstandard.ZstdError):
        return zstandard.decompress(data, LARGEST_RECORD) if data[:4] == ZSTD else data
    return data


def _mcap_messages(bag: Bag, file: Path, stream: IO[bytes], kinds: Collection[str]) -> Iterator[Recorded]:
    """Yield the messages of an MCAP file record by record, without its index: that is written last."""
    from mcap.exceptions import InvalidMagic, McapError
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk
    from zstandard import ZstdError

    broken = (McapError, ZstdError, struct.error, ValueError, OverflowError, RuntimeError, MemoryError)
    schemas: dict[int, str] = {0: "no schema"}
    channels: dict[int, tuple[str, str]] = {}
    lost = 0

    def messages(records: Any) -> Iterator[Recorded]:
        nonlocal lost
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                kind = schemas.get(record.schema_id, "no schema")
                if record.message_encoding != "cdr":
                    kind = f"{kind} as {record.message_encoding}"
                channels[record.id] = record.topic, kind
                bag.topics[record.topic] = kind
            elif isinstance(record, Message) and (channel := channels.get(record.channel_id)) and channel[1] in kinds:
                yield Recorded(*channel, record.log_time, record.data)
            elif isinstance(record, Chunk):
                try:
                    inner = breakup_chunk(record, validate_crc=True)
                except broken:
                    lost += 1
                    continue
                yield from messages(inner)

    try:
        yield from messages(StreamReader(stream, emit_chunks=True, record_size_limit=LARGEST_RECORD).records)
    except InvalidMagic:
        bag.damage.append(f"{file.name} is no MCAP file, or damaged at its beginning or its very end")
    except broken:
        bag.damage.append(f"{file.name} is cut off or damaged after {stream.tell() / 1e6:.1f} MB; the rest is lost")
    if lost:
        bag.damage.append(f"{file.name}: {lost} damaged chunks (stretches of all topics) are lost")


def _sqlite_messages(bag: Bag, file: Path, stream: IO[bytes], kinds: Collection[str]) -> Iterator[Recorded]:
    """Yield the messages of an SQLite file."""
    with contextlib.ExitStack() as closing:
        plain = file
        if file.suffix.lower() == ".zstd":
            temporary = closing.enter_context(tempfile.NamedTemporaryFile(suffix=".db3"))
            shutil.copyfileobj(stream, temporary)
            temporary.flush()
            plain = Path(temporary.name)
        # Immutable: a recording that was not ended must not be changed by its readers either.
        database = closing.enter_context(
            contextlib.closing(sqlite3.connect(f"{plain.absolute().as_uri()}?mode=ro&immutable=1", uri=True))
        )
        count = 0
        try:
            # Else SQLite opens no file that is shorter than it was.
            database.execute("PRAGMA writable_schema = ON")
            rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            if unnamed := [row for row, *names in rows if not all(isinstance(name, str) for name in names)]:
                raise ValueError(f"topic {unnamed[0]} has no name, type or format")
            topics = {row: (name, kind if form == "cdr" else f"{kind} as {form}") for row, name, kind, form in rows}
            bag.topics |= dict(topics.values())
            wanted = [row for row, (_, kind) in topics.items() if kind in kinds]
            marks = ",".join("?" * len(wanted))
            query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"
            for topic, received, data in database.execute(query, wanted):
                count += 1
                yield Recorded(*topics[topic], int(received), bytes(data))
        except (sqlite3.DatabaseError, TypeError, ValueError, OverflowError) as error:
            bag.damage.append(f"{file.name} is damaged ({error}): {count} messages could be read, the rest is lost")
