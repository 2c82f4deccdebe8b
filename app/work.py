"""What a worker can do: each kind of job, as a call of the engine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from app import calibrations, orthoimages, sites
from app.reporter import Reporter
from core.progress import CancelToken
from core.run import run_project

Work = Callable[[Path, dict[str, Any], Reporter, CancelToken], Any]


def _cloud(folder: Path, order: dict[str, Any], report: Reporter, cancel: CancelToken) -> Any:
    sites.read_site(folder, order, report, cancel)
    report.event("inputs", {"kind": "cloud"})
    return None


def _orthoimage(folder: Path, order: dict[str, Any], report: Reporter, cancel: CancelToken) -> Any:
    result = orthoimages.build(folder, order, report, cancel)
    report.event("orthoimage", {"ready": True})
    return result


def _calibrate(folder: Path, order: dict[str, Any], report: Reporter, cancel: CancelToken) -> Any:
    return calibrations.calibrate_lens(folder, order, report, cancel)


def _track(folder: Path, order: dict[str, Any], report: Reporter, cancel: CancelToken) -> Any:
    done = run_project(folder, fresh=bool(order.get("fresh")), progress=report, cancel=cancel)
    return {"frames": done.frames, "frames_measured": done.frames_measured, "measuring_s": done.measuring_s}


WORK: dict[str, Work] = {
    "track": _track,
    "report": _track,
    "calibrate": _calibrate,
    "cloud": _cloud,
    "orthoimage": _orthoimage,
}
