"""The former layout of configurations, as older weights files hold it: parts stood beside what they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

MOVED = (
    ("masks", "stride", "bev", "mask_stride"),
    ("tracking", "query_assignment", "decoder", "query_assignment"),
)
FORMER = ("backbone", "temporal_bev", "quirks")
"""Sections that are parts of others now."""
ENCODER_QUIRKS = {"mirrored_self_attention", "propagate_where_sum_is_positive", "endpoint_warp_grid"}


def in_present_layout(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of a configuration of either layout in the present one.

    It was checked when it was written: image backbone and BEV memory are those that the BEV encoder needs.
    """
    sections = {name: deepcopy(value) for name, value in values.items()}
    touched = {name for row in MOVED for name in row[::2]} | {"bev", "decoder", *FORMER}
    if any(not isinstance(sections.get(name) or {}, dict) for name in touched):
        return sections  # what is wrong is told where its sections are checked
    for section, key, target, name in MOVED:
        if isinstance(sections.get(section), dict) and key in sections[section]:
            sections.setdefault(target, {})[name] = sections[section].pop(key)
    backbone, memory, quirks = (sections.pop(name, None) for name in FORMER)
    for name, part in (("backbone", backbone), ("memory", memory)):
        if part is not None and (part.pop("kind", None), name) != ("resnet50", "backbone"):
            sections.setdefault("bev", {})[name] = part
    for name, on in (quirks or {}).items():
        if on:
            target = sections.setdefault("bev" if name in ENCODER_QUIRKS else "decoder", {})
            target.setdefault("quirks", {})[name] = on
    return sections
