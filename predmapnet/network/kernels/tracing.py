"""Differences of a traced graph from eager code: shapes that depend on data are fixed, and nothing is skipped."""

from __future__ import annotations

import torch
from torch import Tensor


def is_traced() -> bool:
    """Whether the network is being exported; then no Python may look at values."""
    return torch.compiler.is_exporting()


def rows_needed(valid: Tensor, most: int) -> int:
    """Return the largest number of valid rows ``(B, n)`` in a stream; ``most`` in a traced graph."""
    return most if is_traced() else int(valid.sum(dim=1).max())


def stable_order(keys: Tensor) -> Tensor:
    """Return the indices ``(..., n)`` that sort ``keys (..., n)`` along the last axis, equal ones in their order.

    ONNX's only sort is TopK, which by its definition takes the lower index first.
    """
    if is_traced():
        return keys.topk(keys.shape[-1], largest=False, sorted=True).indices
    return keys.argsort(dim=-1, stable=True)
