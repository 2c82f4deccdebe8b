"""Work shared out among the cores of this machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")


def available_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_all_cores(work: Callable[[Part], Result], parts: Iterable[Part]) -> list[Result]:
    """Return what work makes of each part, in their order; for work that lies in numpy, which runs beside itself."""
    parts = list(parts)
    if len(parts) == 1:
        return [work(parts[0])]
    with ThreadPoolExecutor(available_cores()) as pool:
        return list(pool.map(work, parts))
