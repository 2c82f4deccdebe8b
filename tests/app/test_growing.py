"""The displacement as it grows, whichever part of a clip is measured first."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from app.growing import LEAST_FRAMES, _Growth, _look
from app.outcome import loaded
from app.places import Places
from app.store import Workspace
from core.measurements import MeasurementStore
from core.run import FRAMES_FILE
from tests.app.measured import write_measurable
from tests.scenes.clips import measured_history

FRAMES = 40


class Heard:
    """A hub that remembers the frames it was told of."""

    def __init__(self) -> None:
        self.frames: list[list[int]] = []

    def publish(self, project_id: str, kind: str, event: dict[str, Any]) -> None:
        assert (project_id, kind, event["target"]) == ("clip", "track", "roof")
        self.frames.append([row[0] for row in event["rows"]])


def test_new_frames_are_told_once_in_whatever_order_they_are_measured(tmp_path: Path) -> None:
    write_measurable(tmp_path / "clip", FRAMES)
    measured_history(tmp_path / "clip")
    folder = Workspace(tmp_path, Places([tmp_path])).open("clip")
    inputs, hub, growth = loaded(folder, folder.load().project), Heard(), _Growth()
    with MeasurementStore(folder.results / FRAMES_FILE) as store:
        setup = inputs.setup()
        number = store.find(setup.method, setup.fingerprint)
        assert number is not None
        measured = [store.frame(number, frame) for frame in range(FRAMES)]
        anew = store.begin(setup.method, setup.fingerprint, store.reference(number))
        for part in (range(20, 30), range(10), range(10, 10 + LEAST_FRAMES - 1), range(30, FRAMES)):
            for frame in part:
                one = measured[frame]
                assert one is not None
                store.append(anew, one)
            store.commit()
            _look(hub, folder, inputs, growth)  # type: ignore[arg-type]
    told = [list(range(20, 30)), list(range(10)), [*range(10, 10 + LEAST_FRAMES - 1), *range(30, FRAMES)]]
    assert hub.frames == told
    assert [row[0] for row in growth.rows["roof"]] == list(itertools.chain(*told))
