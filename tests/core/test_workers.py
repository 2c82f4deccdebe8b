"""Orders shared out between this process and helpers; what they do stands in for measuring."""

import os
import signal
import time

import numpy as np
import pytest

from core.chunks import Chunk
from core.errors import InputError
from core.measurements import FrameMeasurement
from core.workers import Helpers, Order


def frame_of(number, worker):
    """Return a measurement that tells who made it."""
    return FrameMeasurement(number, float(worker), np.eye(3), np.zeros((1, 2)), {}, {})


def count(order):
    for number in range(order.chunk.start, order.chunk.stop):
        time.sleep(0.001)
        yield frame_of(number, os.getpid())


def refuse(order):
    yield frame_of(order.chunk.start, os.getpid())
    raise InputError("video.mp4: cannot be read any further.")


def die(order):
    yield frame_of(order.chunk.start, os.getpid())
    os.kill(os.getpid(), signal.SIGKILL)


ORDERS = [Order(b"", Chunk(start, start + 10)) for start in range(0, 70, 10)]


def test_all_orders_are_done_once_and_frames_of_a_chunk_come_in_order():
    with Helpers(count, 2) as helpers:
        done = [measured.frame for measured in helpers.measure(ORDERS, count)]
    assert sorted(done) == list(range(70))
    for order in ORDERS:
        assert [frame for frame in done if order.chunk.start <= frame < order.chunk.stop] == list(
            range(order.chunk.start, order.chunk.stop)
        )


def test_helpers_do_their_share_in_processes_of_their_own():
    with Helpers(count, 1) as helpers:
        made_by = {int(measured.time_s) for measured in helpers.measure(ORDERS, count)}
    assert os.getpid() in made_by
    assert len(made_by) == 2


def test_without_helpers_this_process_does_everything_in_order():
    with Helpers(count, 0) as helpers:
        done = [(measured.frame, int(measured.time_s)) for measured in helpers.measure(ORDERS, count)]
    assert done == [(frame, os.getpid()) for frame in range(70)]


def test_what_stops_a_helper_stops_the_run():
    with Helpers(refuse, 1) as helpers, pytest.raises(InputError, match="cannot be read any further"):
        list(helpers.measure(ORDERS, count))


def test_a_helper_that_dies_is_named_with_its_frames():
    with Helpers(die, 1) as helpers, pytest.raises(InputError, match=r"frames 10 to 19 ended unexpectedly \(exit -9\)"):
        list(helpers.measure(ORDERS, count))


def test_helpers_are_gone_at_the_end_even_in_the_middle_of_work():
    with Helpers(count, 2) as helpers:
        going = helpers.measure([Order(b"", Chunk(0, 10**6)) for _ in range(3)], count)
        assert {int(next(going).time_s) for _ in range(3000)} > {os.getpid()}
        processes = [helper.process for helper in helpers._helpers]
        going.close()
    assert [process.is_alive() for process in processes] == [False, False]
