"""Engine values as the browser gets them: arrays as lists, and what is not a number as null."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: dataclasses by field, arrays as lists, nan and infinity as null."""
    if isinstance(value, np.ndarray):
        return _listed(value)
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    return value


def points(array: Any) -> list[Any]:
    """Return (N, 2) or (N, 3) points as lists; null for a point that does not exist."""
    array = np.asarray(array, dtype=np.float64)
    return [row.tolist() if np.isfinite(row).all() else None for row in array]


def _listed(array: Any) -> Any:
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return array.tolist()
    boxed = array.astype(object)
    boxed[~np.isfinite(array)] = None
    return boxed.tolist()
