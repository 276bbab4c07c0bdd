"""JSON of files from anywhere, read with bounds that no honest file comes near."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import orjson

DEEPEST = 100
"""Lists and objects may stand within each other as deep as this."""

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*"', re.DOTALL)
_HALF_CHARACTER = re.compile(rb"\\u[dD][89a-fA-F]")


def parse(data: bytes, unique: bool = False) -> Any:
    """Parse JSON that may begin with a byte-order mark and hold NaN.

    Args:
        data: in UTF-8.
        unique: refuse objects that hold a name twice, of which other readers take the last and say nothing.

    Raises:
        ValueError: no JSON, nested too deeply, or with half a character (a lone surrogate), which no file can hold.
    """
    data = data.removeprefix(_BYTE_ORDER_MARK)
    if _depth(data) > DEEPEST and _depth(_TEXT.sub(b"", data)) > DEEPEST:
        raise ValueError(f"lists and objects stand within each other more than {DEEPEST} deep")
    try:
        if not unique:
            return orjson.loads(data)
        json.loads(data, object_pairs_hook=_with_names_once)
        return orjson.loads(data)
    except orjson.JSONDecodeError as error:
        content = _python_json(data, str(error))
    if _HALF_CHARACTER.search(data):
        try:
            json.dumps(content, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise ValueError("a text holds half a character (a lone surrogate)") from None
    return content


def _python_json(data: bytes, reason: str) -> Any:
    """Parse what Python's own writer makes; ``reason`` is why another parser refused it."""
    try:
        return json.loads(data)
    except ValueError as error:
        raise ValueError(reason if isinstance(error, json.JSONDecodeError) else str(error)) from None


def _depth(data: bytes) -> int:
    """Return how deep brackets stand within each other, those in texts included."""
    brackets = np.frombuffer(data.translate(None, _NO_BRACKETS), dtype=np.uint8)
    # The second bit tells the opening ones.
    return int(np.cumsum((brackets & 2).astype(np.int64) - 1).max(initial=0))


def _with_names_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"it holds the name {next(name for name in names if names.count(name) > 1)[:60]} twice")
    return content
