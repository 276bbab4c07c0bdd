"""JSON files in metres of their own frame, as nuScenes and Argoverse 2 have them: reading, and faults told."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mapfusion import json_text
from mapfusion.elements import ElementKind
from mapfusion.formats.frame_ties import MEMBER, TiedFrame

Position: TypeAlias = tuple[float, float, float]


@contextmanager
def read_document(path: Path, what: str) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yield a document and its provenance; what its reader trips over is a ValueError that names the file.

    Args:
        path: the file.
        what: it should be, for messages.
    """
    try:
        document = json_text.parse(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: not JSON, and so no map: {error}") from error
    origin = document.get(MEMBER) if isinstance(document, dict) else None
    if not isinstance(origin, dict):
        raise ValueError(f"{path}: no {what} of ours: it has no member '{MEMBER}' that says where the map lies")
    try:
        yield document, origin
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        told = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(f"{path}: no {what} as it should be: {told}") from error


def tied_feature(
    kind: ElementKind, positions: Sequence[Position], properties: Mapping[str, Any] | None, frame: TiedFrame
) -> dict[str, Any]:
    """Return a line or ring of metres as a GeoJSON feature; without properties it is one that a person added."""
    table = np.array(positions, dtype=np.float64).reshape(-1, 3)
    degrees = np.column_stack([frame.to_wgs84(table[:, :2]), table[:, 2]]).tolist()
    geometry = (
        {"type": "Polygon", "coordinates": [degrees]}
        if kind.is_ring
        else {"type": "LineString", "coordinates": degrees}
    )
    return {"geometry": geometry, "properties": {**(properties or {}), "kind": kind.label}}
