"""Provenance of what is made of several maps: flags hold if one holds, notes add up, facts that differ are listed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

OF_THE_FILE = {"generator", "version", "created", "georeference", "observed", "sources", "content_sha256"}
"""Facts of a single file, which are not those of a result."""


def united_provenance(several: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what holds for a result that is made of several maps or logs.

    A fact that all of those that state it agree on stays as it is; one that differs becomes the list of its values, in
    the order of the inputs. A flag is true if it is for one of them; the sentences of ``note`` stand one after the
    other, each once.
    """
    values: dict[str, list[Any]] = {}
    listed: set[str] = set()
    for provenance in several:
        for key, value in provenance.items():
            if key in OF_THE_FILE:
                continue
            known = values.setdefault(key, [])
            if isinstance(value, list):
                listed.add(key)
            known.extend(one for one in (value if isinstance(value, list) else [value]) if one not in known)
    return {key: _united(key, found, key in listed) for key, found in values.items()}


def _united(key: str, found: list[Any], listed: bool) -> Any:
    if all(isinstance(value, bool) for value in found):
        return any(found)
    if key == "note":
        texts = [str(note) for note in found]
        return " ".join(text for text in texts if not any(text != other and text in other for other in texts))
    return found[0] if len(found) == 1 and not listed else found
