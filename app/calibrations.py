"""Lens calibration from the browser: its job, its files, its report."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from core.errors import InputError
from core.lens import write_lens
from core.lens_calibration import calibrate
from core.progress import CancelToken, Progress
from core.project import RESULTS_FOLDER
from core.storage import write_atomically

REPORT_FILE = "lens_report.json"
_LENS_FILE = "lens-calibrated.yaml"


def board_of(text: str) -> tuple[int, int]:
    """Return inner corners along and across from a text such as `9x6`.

    Raises:
        InputError: the text is something else.
    """
    found = re.fullmatch(r"\s*(\d{1,3})\s*[x×*]\s*(\d{1,3})\s*", text)
    if found is None:
        raise InputError(f"board: {text!r} is no count of inner corners; write it as 9x6.")
    return int(found[1]), int(found[2])


def calibrate_lens(folder: Path, order: dict[str, Any], progress: Progress, cancel: CancelToken) -> dict[str, Any]:
    """Calibrate a lens and write its file and its report into the project (the job `calibrate`).

    Raises:
        InputError: the pictures do not do.
    """
    files = [Path(file) for file in order["files"]]
    found = calibrate(
        files, board=board_of(order["board"]), square_m=float(order["square_m"]), progress=progress, cancel=cancel
    )
    facts = found.facts() | {"files": order["files"], "lens_file": _LENS_FILE, "report": found.report()}
    write_atomically(folder / RESULTS_FOLDER / REPORT_FILE, json.dumps(facts).encode())
    write_lens(folder / _LENS_FILE, found.lens)
    return {"file": _LENS_FILE, "rms_px": found.lens.rms_px}
