"""Named parts of the video: pre-event, event, residual."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from core.coordinates import Bools


def within(time_s: ArrayLike, interval_s: tuple[float, float] | None) -> Bools:
    """Return which times lie in an interval, both ends included; no interval holds every time.

    Args:
        time_s: (F,), seconds from the first frame.
        interval_s: (start, end), seconds, or None.

    Returns:
        (F,) bool.
    """
    times = np.asarray(time_s, dtype=np.float64)
    if interval_s is None:
        return np.ones(times.shape, dtype=np.bool_)
    return np.asarray((times >= interval_s[0]) & (times <= interval_s[1]), dtype=np.bool_)


def during(time_s: ArrayLike, interval_s: tuple[float, float] | None) -> Bools:
    """Return which times lie in an interval, as `within`, but no interval holds none."""
    return within(time_s, interval_s) & (interval_s is not None)
