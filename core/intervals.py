"""Named parts of the video: pre-event, event, residual."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from core.coordinates import Bools

# Times are the same if they read alike in the tables, to the microsecond: 597 frames at 30 Hz are 19.9 s to a person,
# and 19.900000000000002 s to the machine.
SAME_S = 5e-7


def within(time_s: ArrayLike, interval_s: tuple[float, float] | None) -> Bools:
    """Return which times lie in an interval, both ends included to the microsecond; no interval holds every time.

    Args:
        time_s: (F,), seconds from the first frame.
        interval_s: (start, end), seconds, or None.

    Returns:
        (F,) bool.
    """
    times = np.asarray(time_s, dtype=np.float64)
    if interval_s is None:
        return np.ones(times.shape, dtype=np.bool_)
    return np.asarray((times >= interval_s[0] - SAME_S) & (times <= interval_s[1] + SAME_S), dtype=np.bool_)


def during(time_s: ArrayLike, interval_s: tuple[float, float] | None) -> Bools:
    """Return which times lie in an interval, as `within`, but no interval holds none."""
    return within(time_s, interval_s) & (interval_s is not None)
