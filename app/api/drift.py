"""Drift and validation: filters and spectra to look at, and the comparison with GPS."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter
from pydantic import Field

from app.api.projects import Body
from app.context import Context, Folder, Here
from app.errors import Missing
from app.outcome import Shown
from app.store import ProjectFolder
from core.coordinates import Floats, finite_rows
from core.drift import amplitude_spectrum, corner_sweep, filter_warnings, high_pass
from core.errors import InputError
from core.intervals import during
from core.project import Drift, Positive
from core.results import plain

router = APIRouter(prefix="/api/projects/{project_id}")

PointName = Literal["p1", "p2"]
Order = Annotated[int, Field(ge=1, le=20)]
Corner = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Filter(Body):
    """A high-pass filter to look at; nothing is saved."""

    target: str
    point: PointName = "p1"
    corner_hz: Positive
    order: Order = 10
    interval: tuple[float, float] | None = None


@router.post("/drift")
def drift(wanted: Filter, folder: Folder, here: Here) -> dict[str, Any]:
    """Return the uncorrected displacement and what a filter makes of it, with warnings in words."""
    shown, raw = _raw(here, folder, wanted.target, wanted.point)
    history = shown.history
    intervals, steady = folder.load().project.intervals_s, _steady(here, folder, wanted)
    filtered = high_pass(raw, history.time_s, wanted.corner_hz, wanted.order)
    warnings = filter_warnings(raw, filtered, history.time_s, intervals, corner_hz=wanted.corner_hz, steady_m=steady)
    at_rest = None
    if wanted.interval is not None:
        try:
            found = corner_sweep(
                raw, history.time_s, wanted.interval, corners_hz=[wanted.corner_hz], order=wanted.order
            )
            at_rest = {"dx": plain(found.rms_m[0, 0]), "dy": plain(found.rms_m[0, 1])}
        except InputError as error:  # the curves are worth looking at all the same
            warnings.append(str(error))
    return {
        "frame": history.frame.tolist(),
        "time_s": plain(history.time_s),
        "status": history.status.tolist(),
        "raw": _axes(raw),
        "filtered": _axes(filtered),
        "warnings": warnings,
        "filtered_pre_event_rms_m": at_rest,
        "geometric_pre_event_rms_m": _rms_at_rest(steady, history.time_s, wanted.interval),
        "is_earlier": shown.is_earlier,
    }


@router.get("/drift/sweep")
def sweep(
    target: str, start: float, end: float, folder: Folder, here: Here, point: PointName = "p1", order: Order = 10
) -> dict[str, Any]:
    """Return what each corner frequency would leave of the uncorrected displacement in an interval of rest."""
    shown, raw = _raw(here, folder, target, point)
    found = corner_sweep(raw, shown.history.time_s, (start, end), order=order)
    knee = None
    if found.at_knee_m is not None and found.beyond_knee_m is not None:
        (dx, dy), (least_dx, least_dy) = plain(found.at_knee_m), plain(found.beyond_knee_m)
        knee = {"rms_m": {"dx": dx, "dy": dy}, "least_m": {"dx": least_dx, "dy": least_dy}}
    return {
        "corners_hz": plain(found.corners_hz),
        "rms_m": _axes(found.rms_m),
        "knee_hz": plain(found.knee_hz),
        "knee": knee,
    }


@router.get("/drift/spectrum")
def spectrum(
    target: str, start: float, end: float, folder: Folder, here: Here, point: PointName = "p1"
) -> dict[str, Any]:
    """Return the Fourier amplitudes of the uncorrected displacement in an interval."""
    shown, raw = _raw(here, folder, target, point)
    found = amplitude_spectrum(raw, shown.history.time_s, (start, end))
    dx, dy = found.amplitude_m.T
    return {"frequency_hz": plain(found.frequency_hz), "dx_m": plain(dx), "dy_m": plain(dy)}


def _raw(here: Context, folder: ProjectFolder, target: str, point: PointName) -> tuple[Shown, Floats]:
    shown = here.outcomes.shown(folder, folder.load().project, target)
    return shown, np.asarray(shown.history.p1_raw_m if point == "p1" else shown.history.p2_raw_m)


def _steady(here: Context, folder: ProjectFolder, wanted: Filter) -> Floats | None:
    """Return what the geometric method measured, without a filter, where it has measured."""
    project = folder.load().project
    if "geometric" not in here.outcomes.methods(folder, project):
        return None
    history = here.outcomes.unfiltered(folder, project, wanted.target, "geometric").history
    return history.p1_m if wanted.point == "p1" else history.p2_m


def _rms_at_rest(values: Floats | None, time_s: Floats, interval: tuple[float, float] | None) -> dict[str, Any] | None:
    """Return by how much a displacement (F, 2) scatters about its mean in an interval; None where it was not seen."""
    if values is None or len(values) != len(time_s):
        return None
    inside = values[during(time_s, interval) & finite_rows(values)]
    return {"dx": plain(inside[:, 0].std()), "dy": plain(inside[:, 1].std())} if len(inside) else None


def _axes(values: Floats) -> dict[str, Any]:
    return {"dx": plain(values[:, 0]), "dy": plain(values[:, 1])}


@router.get("/validation")
def validation(
    folder: Folder, here: Here, target: str | None = None, corner_hz: Corner | None = None
) -> dict[str, Any]:
    """Return how the displacement at the antenna compares with GPS; `corner_hz` filters it for the look of it."""
    project = folder.load().project
    if project.inputs.gps is None:
        raise Missing("No GPS record is given; choose one in the inputs.", path="inputs.gps")
    chosen = project.drift
    if corner_hz is not None:
        chosen = Drift(filter="high-pass", order=project.drift.order, corner_hz=corner_hz)
    check = here.outcomes.gps(folder, project, chosen)
    if check is None:
        raise InputError("GPS cannot be compared, because the target was measured in too few frames.")
    compared = check.comparison
    history = here.outcomes.history(folder, project, check.target)
    message = compared.message
    if target is not None and target != check.target:
        message = (
            f"GPS is compared with {check.target}, the highest target, where the antenna stands. {message}".strip()
        )
    return {
        "target": check.target,
        "gps": _curve(compared.time_s, compared.gps_m),
        "video": _curve(history.time_s, check.moved_m),
        "error": _curve(compared.time_s, compared.error_m),
        "lag_s": plain(compared.lag_s),
        "lag_sigma_s": plain(compared.lag_sigma_s),
        "correlation": plain(compared.correlation),
        "rms_m": {"x": plain(compared.rms_m[0]), "y": plain(compared.rms_m[1])},
        "table": plain(compared.table()),
        "is_coarse": compared.is_coarse,
        "spacing": compared.spacing,
        "message": message,
    }


def _curve(time_s: Floats, values_m: Floats) -> dict[str, Any]:
    return {"time_s": plain(time_s), "dx_m": plain(values_m[:, 0]), "dy_m": plain(values_m[:, 1])}
