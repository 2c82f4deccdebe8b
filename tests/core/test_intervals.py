from __future__ import annotations

import numpy as np

from core.intervals import during, within

TIME_S = np.arange(5) / 2


def test_both_ends_of_an_interval_lie_in_it() -> None:
    assert within(TIME_S, (0.5, 1.5)).tolist() == [False, True, True, True, False]
    assert during(TIME_S, (0.5, 1.5)).tolist() == [False, True, True, True, False]


def test_no_interval_holds_all_for_one_and_nothing_for_the_other() -> None:
    assert within(TIME_S, None).all()
    assert not during(TIME_S, None).any()
