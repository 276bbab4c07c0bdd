"""Base of all sections of the configuration, and the kinds of numbers in them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, model_validator

Positive = Annotated[int, Field(gt=0, le=65_536)]
Few = Annotated[int, Field(gt=0, le=64)]
"""Layers, blocks, and what else a network has a handful of."""
Cells = Annotated[int, Field(gt=0, le=1_000)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Metres = Annotated[float, Field(gt=0.0, le=10_000.0)]


def _increasing(values: tuple[float, ...]) -> tuple[float, ...]:
    if any(far <= near for near, far in pairwise(values)):
        raise ValueError("should increase")
    return values


Distances = Annotated[tuple[Metres, ...], Field(min_length=1), AfterValidator(_increasing)]
"""Metres back, the nearest first."""


class Section(BaseModel):
    """Base of all sections: unknown keys are refused and values do not change after construction."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class AttentionSection(Section):
    """Base of sections with attention: each head takes its share of the width."""

    width: Positive
    heads: Few

    @model_validator(mode="after")
    def _heads_share_the_width(self) -> Self:
        if self.width % self.heads:
            raise ValueError(f"width {self.width} has to be a multiple of heads ({self.heads})")
        return self


class Quirks(Section):
    """Base of the oddities of the official code of MapTracker, part by part.

    Its released weights need all of it; a network trained from scratch does not.
    """

    @classmethod
    def official(cls) -> Self:
        """Return all quirks switched on."""
        return cls(**dict.fromkeys(cls.model_fields, True))


def kind_of(default: str) -> Discriminator:
    """Tell sections of one name apart by their ``kind``; files that were written before there were two have none."""

    def kind(value: object) -> str:
        return str(value.get("kind", default) if isinstance(value, Mapping) else getattr(value, "kind", ""))

    return Discriminator(kind)
