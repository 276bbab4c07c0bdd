"""Mutations of files: bytes of any of them, and values of those whose structure is known."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import feather

from tests.fuzzing.stored_messages import mcap_mutated, sqlite_mutated

Mutation = Callable[[bytes, random.Random], bytes]

TEXTS = ["", "x", "-1", "0", "1e308", "nan", "inf", "-inf", "[]", "{}", "null", "true", "9" * 25, "²", "solid", "<a>",
         "../../up", "/etc", "a\\b", "\0", "\u202e", "1e-320", "0x10", "1_0"]  # fmt: skip
TOKEN = re.compile(rb'"[^"]*"|-?\d+(?:\.\d+)?(?:e-?\d+)?|null|true')
RAW = {"deep": "[" * 1010 + "]" * 1010, "deeper": "[" * 100_000 + "]" * 100_000, "digits": "9" * 5000,
       "objects": '{"a":' * 1010 + "1" + "}" * 1010, "overflow": "1e999"}  # fmt: skip
"""Texts of values that no Python object writes."""
VALUES: list[Any] = [None, True, False, "", "x", 0, 1, -1, 3, 7, 0.5, -0.0, 1e308, -1e308, 1e-308, 1e20, float("nan"),
                     float("inf"), float("-inf"), 2**31, 2**63 - 1, 2**63, -(2**63), 2**64, 10**30, [], {}, [[]],
                     [None], "nan", "1", "\0", "../../up", "/etc/passwd", "\ud800", "a" * 5000, "²", [1, 2],
                     [[1, 2], [3]], {"x": 1}, *(f"@{name}@" for name in RAW)]  # fmt: skip


def bytes_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return content with values exchanged or bytes changed, doubled or cut off."""
    for _ in range(generator.choice([1, 1, 2, 5])):
        tokens = list(TOKEN.finditer(content)) if generator.random() < 0.6 else []
        at = generator.randrange(max(len(content), 1))
        if tokens:
            token, value = generator.choice(tokens), generator.choice(TEXTS).encode()
            quoted = b'"%b"' % value if token[0].startswith(b'"') else value
            content = content[: token.start()] + quoted + content[token.end() :]
        elif generator.random() < 0.5:
            content = content[:at] + bytes([generator.randrange(256)]) + content[at + generator.choice([0, 1, 40]) :]
        else:
            content = content[:at] + (
                content[at // 2 : at // 2 + 50] + content[at:] if generator.random() < 0.8 else b""
            )
    return content


def json_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return a JSON document with values, names or members changed."""
    document = json.loads(content)
    repeated = False
    for _ in range(generator.choice([1, 1, 1, 2, 4])):
        places = list(_places(document))
        if not places:
            break
        parent, key = generator.choice(places)
        chosen = generator.random()
        if chosen < 0.5:
            parent[key] = deepcopy(generator.choice(VALUES))  # later changes must not reach VALUES
        elif chosen < 0.6:
            del parent[key]
        elif chosen < 0.75:
            other, place = generator.choice(places)
            parent[key] = _copied(other[place]) if place in other or isinstance(other, list) else None
        elif isinstance(parent, list):
            _list_mutated(parent, key, generator)
        elif chosen < 0.9:
            parent[generator.choice(["", "x", "token", "name", "type", "@digits@"])] = parent.pop(key)
        else:
            parent[f"{key}@again@"], repeated = deepcopy(generator.choice([parent[key], *VALUES])), True
    text = json.dumps(document, indent=generator.choice([None, 1]))
    if repeated:
        text = text.replace("@again@", "")
    for name, raw in RAW.items():
        text = text.replace(f'"@{name}@"', raw if name != "digits" or f'"@{name}@":' not in text else '"9"')
    return text.encode("utf-8")


def _places(node: Any) -> Any:
    """Yield every member of a document as its parent and its key there."""
    members = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    for key in members:
        yield node, key
        yield from _places(node[key])


def _copied(node: Any) -> Any:
    return json.loads(json.dumps(node))


def _list_mutated(items: list[Any], at: int, generator: random.Random) -> None:
    action = generator.randrange(5)
    if action == 0:
        items.insert(at, _copied(items[at]))
    elif action == 1:
        items[:] = items[:at]
    elif action == 2:
        items.reverse()
    elif action == 3:
        items.extend(_copied(items) * generator.choice([1, 20]))
    else:
        other = generator.randrange(len(items))
        items[at], items[other] = items[other], items[at]


def rows_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return a table in text (CSV, or words with blanks between) with cells, columns or rows changed."""
    lines = content.decode().splitlines()
    separator = "," if "," in lines[0] else " "
    table = [line.split(separator) for line in lines]
    for _ in range(generator.choice([1, 1, 2, 4])):
        row = generator.choice(table)
        if not row:
            continue
        at, action = generator.randrange(len(row)), generator.randrange(8)
        if action < 3:
            row[at] = generator.choice([*TEXTS, "9" * 5000, '"', "1e18", "-5"])
        elif action == 3:
            row[at] = generator.choice(generator.choice(table) or [""])
        elif action == 4:
            del row[at]
        elif action == 5:
            for other in table:
                other[at : at + 1] = generator.choice([[], other[at : at + 1] * 2])
        elif action == 6:
            table.append(list(row))
        else:
            generator.shuffle(table)
    ending = generator.choice(["\n", "\r\n", "\r"])
    text = ending.join(separator.join(row) for row in table) + ending
    return text.encode(generator.choice(["utf-8", "utf-8", "utf-8-sig", "utf-16"]), errors="replace")


KINDS = [pa.float64(), pa.string(), pa.int64(), pa.uint64(), pa.bool_(), pa.float32(), pa.float16(), pa.binary(),
         pa.int8(), pa.list_(pa.float64()), pa.null(), pa.timestamp("ns"), pa.decimal128(30, 2),
         pa.dictionary(pa.int32(), pa.string())]  # fmt: skip
"""Kinds of columns."""


def arrow_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return a feather or Parquet file whose columns have other names, kinds or values."""
    parquet = content[:4] == b"PAR1"
    table = pq.read_table(io.BytesIO(content)) if parquet else feather.read_table(io.BytesIO(content))
    for _ in range(generator.choice([1, 1, 2])):
        at = generator.randrange(table.num_columns) if table.num_columns else None
        if at is None:
            break
        name, column = table.column_names[at], table.column(at)
        action = generator.randrange(8)
        if action == 0:
            table = table.remove_column(at)
        elif action == 1:
            table = table.append_column(name if generator.random() < 0.7 else "x", column)
        elif action == 2:
            table = table.rename_columns([generator.choice(["", "x", other]) for other in table.column_names])
        elif action == 3:
            metadata = {
                key: _metadata_mutated(value, generator) for key, value in (table.schema.metadata or {}).items()
            }
            table = table.replace_schema_metadata(metadata)
        elif action == 4:
            table = generator.choice([table.slice(0, 0), table.slice(1), pa.concat_tables([table] * 3)])
        else:
            table = table.set_column(at, name, _column_mutated(column, generator))
    buffer = io.BytesIO()
    if parquet:
        pq.write_table(table, buffer, compression=generator.choice(["zstd", "snappy", "none"]))
    else:
        feather.write_feather(table, buffer, compression=generator.choice(["lz4", "zstd", "uncompressed"]))
    return buffer.getvalue()


def _metadata_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return metadata (JSON, another text, or py123d's MessagePack) with members or bytes changed."""
    if content[:1] < b"\x80" or generator.random() < 0.2:
        return bytes_mutated(content, generator)
    try:
        document = json.dumps(msgpack.unpackb(content)).encode()
    except (ValueError, TypeError):  # changed before
        return bytes_mutated(content, generator)
    changed = json_mutated(document, generator)
    try:
        return bytes(msgpack.packb(json.loads(changed)))
    except (ValueError, OverflowError, RecursionError, UnicodeEncodeError):
        return changed


def _column_mutated(column: pa.ChunkedArray, generator: random.Random) -> pa.ChunkedArray | pa.Array:
    """Return a column of another kind, or with other values; as it is where its kind does not take them."""
    values = column.cast(pa.int64()).to_pylist() if pa.types.is_timestamp(column.type) else column.to_pylist()
    at = generator.randrange(max(len(values), 1))
    kind = generator.choice([column.type, column.type, *KINDS])
    action = generator.randrange(4)
    if values and action < 2:
        values[at] = generator.choice([None, -1, 0, 1e308, float("nan"), float("inf"), 2**63 - 1, 7, "x", "", [], [1.0],
                                       [float("nan")], values[generator.randrange(len(values))]])  # fmt: skip
    elif action == 2:
        values = [generator.choice([None, 0, 1, -1, 1e308, 2**62, float("nan"), values[0] if values else 0])] * len(
            values
        )
    for candidate in (kind, column.type):
        try:
            return pa.array(values, candidate)
        except (pa.ArrowException, TypeError, ValueError, OverflowError):
            continue
    return pa.nulls(len(column), column.type)


def image_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return a JPEG or PNG with another header, with chunks changed, or with checksums that fit other bytes."""
    if content[:2] == b"\xff\xd8":
        return _jpeg_mutated(bytearray(content), generator)
    chunks, at = [], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        chunks.append([content[at + 4 : at + 8], content[at + 8 : at + 8 + length]])
        at += 12 + length
    action, place = generator.randrange(4), generator.randrange(len(chunks))
    if action == 0:
        size = [generator.choice([0, 1, 64, 30_000, 2**20, 2**31 - 1, 2**32 - 1]) for _ in range(2)]
        chunks[0][1] = struct.pack(">II", *size) + chunks[0][1][8:]
    elif action == 1:
        chunks[0][1] = chunks[0][1][:8] + bytes(generator.randrange(17) for _ in range(5))
    elif action == 2:
        chunks[place][1] = bytes_mutated(chunks[place][1], generator)
    else:
        chunks[place:place] = generator.choice(
            [[], [chunks[place]], [[b"tEXt", b"a\0" + b"b" * 50]], [[b"PLTE", b"abc"]]]
        )
        if generator.random() < 0.3:
            del chunks[place]
    parts = [struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks]
    return content[:8] + b"".join(parts)


def _jpeg_mutated(content: bytearray, generator: random.Random) -> bytes:
    at = content.find(b"\xff\xc0")
    action = generator.randrange(4)
    if action == 0 and at > 0:
        content[at + 5 : at + 9] = struct.pack(">HH", *(generator.choice([0, 1, 9, 30_000, 65_535]) for _ in range(2)))
    elif action == 1 and at > 0:
        content[at + generator.randrange(2, 19)] = generator.randrange(256)
    elif action == 2:
        extra = bytes(generator.randrange(256) for _ in range(generator.randrange(60)))
        content[2:2] = (
            b"\xff"
            + bytes([generator.choice([0xE1, 0xE0, 0xFE, 0xDB, 0xC4, 0xDA])])
            + struct.pack(">H", generator.choice([len(extra) + 2, 0, 1, 65_535]))
            + extra
        )
    else:
        content += bytes(generator.randrange(256) for _ in range(40))
    return bytes(content)


def safetensors_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return a safetensors file with another header: names, shapes, kinds, offsets, or our own metadata.

    Bytes of the header are changed, too: those of its numbers are of less interest.
    """
    (length,) = struct.unpack("<Q", content[:8])
    if generator.random() < 0.35:
        return bytes_mutated(content[: 8 + length], generator) + content[8 + length :]
    header, rest = json.loads(content[8 : 8 + length]), content[8 + length :]
    if "__metadata__" in header and generator.random() < 0.7:
        name, text = next(iter(header["__metadata__"].items()))
        mutate = generator.choice([json_mutated, json_mutated, json_mutated, bytes_mutated])
        header["__metadata__"][name] = mutate(text.encode(), generator).decode(errors="replace")
        encoded = json.dumps(header).encode()
    else:
        encoded = json_mutated(json.dumps(header).encode(), generator)
        if generator.random() < 0.3:
            encoded = encoded.replace(b"F32", generator.choice([b"F16", b"BF16", b"I64", b"F64", b"BOOL", b"F8_E4M3"]))
    return struct.pack("<Q", len(encoded)) + encoded + rest


def zip_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return a ZIP archive (npz, or a checkpoint of torch) with a member changed, renamed or left out."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, action = generator.choice(list(members)), generator.randrange(6)
    if action == 0:
        members[name + "x"] = members.pop(name)
    elif action == 1:
        del members[name]
    elif action == 2 and name.endswith(".npy"):
        members[name] = _array_mutated(members[name], generator)
    elif action == 3:
        members[name] = members[generator.choice(list(members))]
    else:
        members[name] = bytes_mutated(members[name], generator)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", generator.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])) as archive:
        for each, data in members.items():
            archive.writestr(each, data)
    return packed.getvalue()


def _array_mutated(content: bytes, generator: random.Random) -> bytes:
    """Return an array of numpy's with another shape, kind or value, or with a header that lies."""
    array = np.load(io.BytesIO(content), allow_pickle=False)
    action = generator.randrange(6)
    if action == 0:
        array = array.astype(generator.choice(["f4", "f8", "i8", "u1", "bool", "U5", "c16", "O"]), copy=False)
    elif action == 1:
        array = generator.choice([array[None], array.reshape(-1), array[..., None], array.ravel()[:0], np.array(7)])
    elif action == 2 and array.size:
        array = array.copy()
        array.flat[generator.randrange(array.size)] = np.array(generator.choice([0, 1, 100, -1])).astype(array.dtype)
    elif action == 3 and array.dtype.kind == "f":
        array = np.full(array.shape, generator.choice([np.nan, np.inf, 1e30, -1.0]))
    elif action == 4:
        shape = str(array.shape).encode()
        return content.replace(shape, generator.choice([b"(99999999999,)", b"(-1,)", b"()", b"(2, 2)"]), 1)
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)  # an array of objects is a pickle, which must not be read
    return buffer.getvalue()


STRUCTURED: dict[str, Mutation] = {
    ".json": json_mutated,
    ".geojson": json_mutated,
    ".csv": rows_mutated,
    ".txt": rows_mutated,
    ".tum": rows_mutated,
    ".feather": arrow_mutated,
    ".arrow": arrow_mutated,
    ".mcap": mcap_mutated,
    ".db3": sqlite_mutated,
    ".gpkg": sqlite_mutated,
    ".parquet": arrow_mutated,
    ".jpg": image_mutated,
    ".png": image_mutated,
    ".safetensors": safetensors_mutated,
    ".npz": zip_mutated,
    ".pth": zip_mutated,
}
"""By the ending of a file, what its structure allows."""


def mutated(ending: str, content: bytes, others: list[bytes], generator: random.Random) -> bytes:
    """Return the content of a file, changed; sometimes it is another file's."""
    chosen = generator.random()
    if chosen < 0.02:
        return generator.choice([b"", b"\0" * 1000, b"\xef\xbb\xbf", *others])
    structured = STRUCTURED.get(ending)
    plain = 0.05 if structured is safetensors_mutated else 0.35
    if structured is None or chosen < plain or (structured is zip_mutated and content[:2] != b"PK"):
        return bytes_mutated(content, generator)
    return structured(content, generator)
