"""What a worker can do: each kind of job, as a call of the engine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from app import calibrations, orthoimages, sites
from app.worker import Reporter
from core.progress import CancelToken

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


WORK: dict[str, Work] = {
    "calibrate": _calibrate,
    "cloud": _cloud,
    "orthoimage": _orthoimage,
}
