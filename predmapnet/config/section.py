"""Base of all sections of the configuration, and the kinds of numbers in them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field

Positive = Annotated[int, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Metres = Annotated[float, Field(gt=0.0)]


def _increasing(values: tuple[float, ...]) -> tuple[float, ...]:
    if any(far <= near for near, far in pairwise(values)):
        raise ValueError("should increase")
    return values


Distances = Annotated[tuple[Metres, ...], Field(min_length=1), AfterValidator(_increasing)]
"""Metres back, the nearest first."""


class Section(BaseModel):
    """Base of all sections: unknown keys are refused and values do not change after construction."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def kind_of(default: str) -> Discriminator:
    """Tell sections of one name apart by their ``kind``; files that were written before there were two have none."""

    def kind(value: object) -> str:
        return str(value.get("kind", default) if isinstance(value, Mapping) else getattr(value, "kind", ""))

    return Discriminator(kind)
