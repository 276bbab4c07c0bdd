"""Types of arrays, as they stand in signatures; shapes and units stand in the docstrings."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Float: TypeAlias = NDArray[np.float64]
Float32: TypeAlias = NDArray[np.float32]
Integer: TypeAlias = NDArray[np.int64]
Integer32: TypeAlias = NDArray[np.int32]
Byte: TypeAlias = NDArray[np.uint8]
Bool: TypeAlias = NDArray[np.bool_]
Rows: TypeAlias = NDArray[np.intp]
Marks: TypeAlias = NDArray[np.uint64]
