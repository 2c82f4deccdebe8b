from __future__ import annotations

import threading

import pytest

from core.parallel import available_cores, on_all_cores


def test_results_come_in_the_order_of_their_parts() -> None:
    assert on_all_cores(lambda part: part * part, range(50)) == [part * part for part in range(50)]
    assert on_all_cores(str, []) == []


def test_parts_run_beside_each_other() -> None:
    if available_cores() < 2:
        pytest.skip("one core has nothing beside it")
    both = threading.Barrier(2, timeout=20)
    on_all_cores(lambda part: both.wait(), [0, 1])


def test_what_a_part_raises_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda part: 1 // part, [2, 1, 0])
