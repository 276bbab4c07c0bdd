"""Mutations of recordings and databases: messages of a bag, and rows of SQLite, under checksums that fit."""

from __future__ import annotations

import io
import random
import sqlite3
import struct
from contextlib import closing, suppress
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

WORDS = [struct.pack("<d", number) for number in (float("nan"), float("inf"), 0.0, 1e308, -1.0, 1e20, 1e-320)]
WORDS += [struct.pack("<I", number) for number in (0, 1, 9, 2**16, 2**31 - 1, 2**31, 2**32 - 1)]
NAMES = ["", "x", "/tf", "map", "base_link", "../../up", "/", "//", "a\0b", "²", "sensor_msgs/msg/Image", "cdr", "json"]
CELLS: list[Any] = [None, "", "x", 0, -1, 3, 2**31, 2**63 - 1, -(2**63), 1e308, float("inf"), b"", b"\0", b"\xff" * 40,
                    "../../up", "\0", "cdr", *NAMES]  # fmt: skip


def words_mutated(data: bytes, generator: random.Random) -> bytes:
    """Return a serialised message with numbers, lengths or texts exchanged, most near its beginning."""
    for _ in range(generator.choice([1, 1, 2, 4])):
        at = 4 * generator.randrange(max(min(len(data), generator.choice([80, 80, 10_000])) // 4, 1))
        action = generator.randrange(8)
        if action < 5:
            word = generator.choice(WORDS)
            data = data[:at] + word + data[at + len(word) :]
        elif action == 5:
            data = data[:at] + bytes([generator.randrange(256)]) + data[at + 1 :]
        elif action == 6:
            data = data[:at]
        else:
            data = data[:at] + data[at // 2 : at // 2 + 8] + data[at:]
    return data


def mcap_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return an MCAP file with messages, their times, topics, types or order changed."""
    messages: list[list[Any]] = [
        [schema.name, channel.topic, channel.message_encoding, message.log_time, message.data]
        for schema, channel, message in make_reader(io.BytesIO(content)).iter_messages(log_time_order=False)
        if schema is not None
    ]
    for _ in range(generator.choice([1, 1, 2, 5])):
        row = generator.randrange(len(messages))
        action, changed = generator.randrange(10), list(messages[row])
        if action < 5:
            changed[4] = words_mutated(changed[4], generator)
        elif action == 5:
            changed[3] = generator.choice([0, 1, 2**63 - 1, 2**63, 2**64 - 1, messages[0][3]])
        elif action == 6:
            changed[generator.randrange(3)] = generator.choice(NAMES)
        elif action == 7:
            changed[4] = generator.choice(messages)[4]
        elif action == 8:
            messages.append(changed)
        else:
            generator.shuffle(messages)
            continue
        messages[row] = changed
    file = io.BytesIO()
    writer = Writer(file, compression=generator.choice([CompressionType.NONE, CompressionType.ZSTD]))
    writer.start()
    channels: dict[tuple[str, ...], int] = {}
    for kind, topic, encoding, time, data in messages:
        if (kind, topic, encoding) not in channels:
            schema = writer.register_schema(kind, "ros2msg", b"")
            channels[kind, topic, encoding] = writer.register_channel(topic, encoding, schema)
        writer.add_message(channels[kind, topic, encoding], log_time=time, publish_time=time, data=data)
    writer.finish()
    return file.getvalue()


def sqlite_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return an SQLite database with cells, columns, rows or tables changed, where its rules allow it."""
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(content)
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        with suppress(sqlite3.Error):  # These call functions of spatial databases.
            for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{name}"')
        for _ in range(generator.choice([1, 1, 2, 4])):
            with suppress(sqlite3.Error):
                _database_changed(database, generator.choice(names), generator)
        database.commit()
        return database.serialize()


def _database_changed(database: sqlite3.Connection, table: str, generator: random.Random) -> None:
    columns = [row[1] for row in database.execute(f'PRAGMA table_info("{table}")')]
    rows = [row for (row,) in database.execute(f'SELECT rowid FROM "{table}"')]
    column, row = generator.choice(columns), generator.choice(rows or [0])
    (old,) = database.execute(f'SELECT "{column}" FROM "{table}" WHERE rowid = ?', (row,)).fetchone() or (None,)
    action = generator.randrange(12)
    if action < 8:
        blob = old if isinstance(old, bytes) and generator.random() < 0.8 else None
        value = generator.choice(CELLS) if blob is None else words_mutated(blob, generator)
        database.execute(f'UPDATE "{table}" SET "{column}" = ? WHERE rowid = ?', (value, row))
    elif action == 8:
        database.execute(f'DELETE FROM "{table}" WHERE rowid = ?', (row,))
    elif action == 9:
        database.execute(f'UPDATE "{table}" SET "{column}" = ?', (generator.choice([old, *CELLS]),))
    elif action == 10:
        database.execute(f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "{generator.choice(["x", *columns])}"')
    else:
        database.execute(f'ALTER TABLE "{table}" RENAME TO "{generator.choice(["x", "messages"])}"')
