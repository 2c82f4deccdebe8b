"""The displacement as it grows: new frames of a running measurement, solved roughly for the plot of the Track page.

No calibration, no interval of rest: displacement from the reference frame, from the frames' own geometry alone. What
the results say comes from the whole record once it is complete.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, field
from typing import Any

from app.errors import ApiError
from app.events import Hub
from app.jobs import Job
from app.outcome import loaded, wanted_fingerprint
from app.store import ProjectFolder
from core.errors import InputError
from core.measurements import MeasurementStore
from core.project import Drift, Intervals, Project
from core.results import TargetHistory, plain
from core.run import FRAMES_FILE, LoadedInputs
from core.solve import solve

_PAUSE_S = 1.0
# Fewer new frames are not worth a solve of their own.
LEAST_FRAMES = 8

Row = list[Any]
log = logging.getLogger("rooftrack")


@dataclass(eq=False)
class _Growth:
    """What is known so far of one running measurement.

    Attributes:
        rows: by target, in the order in which they came: processes measure several parts of a clip at a time.
        seen: frames that are among them.
    """

    rows: dict[str, list[Row]] = field(default_factory=dict)
    seen: set[int] = field(default_factory=set)


class Growing:
    """Follows running measurements."""

    def __init__(self) -> None:
        self._growths: dict[str, _Growth] = {}

    def rows(self, project_id: str) -> dict[str, list[Row]]:
        """Return all rows so far, by target: frame, time, dx, dy of P1, status."""
        growth = self._growths.get(project_id)
        return {name: list(rows) for name, rows in growth.rows.items()} if growth else {}

    def follow(self, hub: Hub, folder: ProjectFolder, job: Job) -> None:
        """Follow a job until it ends, telling the tabs of new rows."""
        growth = self._growths[folder.id] = _Growth()
        args = (hub, folder, job, growth)
        threading.Thread(target=self._follow, args=args, name="growing", daemon=True).start()

    def _follow(self, hub: Hub, folder: ProjectFolder, job: Job, growth: _Growth) -> None:
        wait = threading.Event()
        inputs: LoadedInputs | None = None
        while job.is_running:
            wait.wait(_PAUSE_S)
            try:
                if inputs is None:
                    inputs = loaded(folder, folder.load().project)
                _look(hub, folder, inputs, growth)
            except (ApiError, InputError) as error:
                log.debug("no preview of %s yet: %s", folder.id, error)


def _look(hub: Hub, folder: ProjectFolder, inputs: LoadedInputs, growth: _Growth) -> None:
    file = folder.results / FRAMES_FILE
    if not file.is_file():
        return
    with MeasurementStore(file) as store:
        number = store.find(inputs.project.method, wanted_fingerprint(inputs.video, inputs.project))
        if number is None:
            return
        fresh = [frame for frame in store.measured_frames(number) if frame not in growth.seen]
        if len(fresh) < LEAST_FRAMES:
            return
        recording = store.load(number, only=fresh)
    growth.seen.update(fresh)
    solution = solve(recording, _plain(inputs.project), inputs.lens, inputs.relief, has_lens=inputs.has_lens)
    for name, history in solution.histories.items():
        rows = rows_of(history)
        growth.rows.setdefault(name, []).extend(rows)
        hub.publish(folder.id, "track", {"target": name, "rows": rows})


def _plain(project: Project) -> Project:
    return project.model_copy(update={"intervals_s": Intervals(), "drift": Drift()})


def rows_of(history: TargetHistory) -> list[Row]:
    """Return a history as rows of frame, time, dx, dy of P1, status."""
    columns = (history.frame, history.time_s, history.p1_m[:, 0], history.p1_m[:, 1])
    numbers = zip(*(plain(column) for column in columns), strict=True)
    return [[*row, status] for row, status in zip(numbers, history.status.tolist(), strict=True)]
