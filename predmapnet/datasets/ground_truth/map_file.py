"""Map files of data sets, read with a digest of their content."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import orjson
import shapely

from predmapnet.datasets.large_tables import parse_json
from predmapnet.errors import UserError

MALFORMED = (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError, shapely.GEOSException)
"""Errors of a reader on a map that is not as it should be."""


def read_map_file(source: Path | Mapping[str, Any]) -> tuple[Mapping[str, Any], bytes]:
    """Read a map, from a JSON file or its content: the content, and the SHA-256 digest of its bytes.

    Raises UserError for a file that is missing, damaged, or not one JSON object.
    """
    if isinstance(source, Mapping):
        return source, hashlib.sha256(orjson.dumps(source)).digest()
    try:
        data = source.read_bytes()
    except OSError as error:
        raise UserError(f"Cannot read the map {source}: {error.strerror}.") from None
    content = parse_json(data, source)
    if not isinstance(content, dict):
        raise UserError(f"{source} is not a map: it must be one JSON object.")
    return content, hashlib.sha256(data).digest()
