from __future__ import annotations

import numpy as np
import pytest

from core.intervals import during, within


@pytest.mark.parametrize("rate_hz", [24, 30, 30000 / 1001, 50, 60, 120])
def test_both_ends_are_included_as_they_read_in_the_table(rate_hz: float) -> None:
    tick_s = 1 / 90_000
    time_s = np.rint(np.arange(900) / rate_hz / tick_s) * tick_s
    for first, last in ((100, 897), (210, 597), (1, 3)):
        interval_s = float(f"{time_s[first]:.6f}"), float(f"{time_s[last]:.6f}")
        assert np.flatnonzero(within(time_s, interval_s)).tolist() == list(range(first, last + 1))


def test_no_interval_holds_every_time_or_none() -> None:
    assert within([0.0, 1.0], None).all()
    assert not during([0.0, 1.0], None).any()
