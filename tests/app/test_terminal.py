"""Progress on a terminal and in a log."""

from __future__ import annotations

import io
import re

import pytest

from app.terminal import TerminalProgress, clock_text


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def run(out: io.StringIO, *, frames: int, rate_hz: float, first: int = 0) -> str:
    clock = Clock()
    progress = TerminalProgress(out, clock=clock)
    for done in range(first, frames + 1):
        progress("measuring", done, frames)
        clock.now_s += 1 / rate_hz
    progress.close()
    return out.getvalue()


def test_a_terminal_sees_stage_share_rate_and_time_left() -> None:
    text = run(Terminal(), frames=600, rate_hz=40)
    lines = text.split("\r")
    halfway = next(line for line in lines if re.search(r"(29|30)\d/600", line))
    assert re.search(r"measuring +━+─+ +(48|49|50|51)%  \d+/600 frames  40.0 frames/s  0:0[78] left", halfway)
    assert "100%" in lines[-1]
    assert text.endswith("\n")
    assert text.count("\n") == 1


def test_a_terminal_is_redrawn_no_faster_than_eyes_follow() -> None:
    assert run(Terminal(), frames=1000, rate_hz=1000).count("\r") <= 12


def test_the_rate_of_a_resumed_run_is_that_of_this_run() -> None:
    assert "10.0 frames/s" in run(Terminal(), frames=600, rate_hz=10, first=580)


def test_a_log_gets_a_line_now_and_then() -> None:
    text = run(io.StringIO(), frames=600, rate_hz=20)
    assert "\r" not in text
    assert len(text.splitlines()) == 3
    assert text.splitlines()[-1].split() == ["measuring", "100%", "600/600", "frames", "20.0", "frames/s", "0:30"]


def test_stages_follow_each_other_on_lines_of_their_own() -> None:
    out = io.StringIO()
    progress = TerminalProgress(out, clock=Clock())
    progress("cloud", 1, 1)
    progress("solving", 0, 1)
    progress("solving", 1, 1)
    progress.close()
    assert [line.split() for line in out.getvalue().splitlines()] == [
        ["cloud", "100%", "0:00"],
        ["solving", "100%", "0:00"],
    ]


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (65, "1:05"), (3725, "1:02:05")])
def test_durations_read_as_on_a_clock(seconds: float, text: str) -> None:
    assert clock_text(seconds) == text
