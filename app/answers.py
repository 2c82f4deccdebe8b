"""Points as the browser gets them."""

from __future__ import annotations

from typing import Any

import numpy as np


def points(array: Any) -> list[Any]:
    """Return (N, 2) or (N, 3) points as lists; null for a point that does not exist."""
    array = np.asarray(array, dtype=np.float64)
    return [row.tolist() if np.isfinite(row).all() else None for row in array]
