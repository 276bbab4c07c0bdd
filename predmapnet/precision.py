"""The precision in which a network may compute."""

from __future__ import annotations

from enum import StrEnum


class Precision(StrEnum):
    """Numbers that the image backbone and the BEV encoder compute with; everything else computes in float32."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"
