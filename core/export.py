"""What a solve found out, written for people: histories as CSV, the summary, figures and the report.

All that may be refused is computed before the first file is touched, so that a refusal leaves earlier results as they
were; each file takes its predecessor's place in one step, the summary last.
"""

from __future__ import annotations

import dataclasses
import errno
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from core.camera import PoseFit, project
from core.coordinates import Bools, Floats
from core.drift import filter_warnings
from core.errors import DISK_FULL
from core.flight import SmoothFlight
from core.gps_record import GpsRecord
from core.lens import Lens
from core.measurements import Recording
from core.motion import LineSet, fit_line
from core.progress import Progress, silent
from core.project import LINE_NAMES, Project, Target
from core.report import Correction, Fact, InputFile, ReportContent, ReportFigure, TargetReport, write_report
from core.results import (
    CSV_HEADER,
    TargetHistory,
    displacement_at,
    summarise,
    write_history_csv,
    write_summary,
)
from core.self_calibration import SelfCalibration
from core.solution import Ground, Solution
from core.solve import filtered, unfiltered_history
from core.storage import File, write_atomically
from core.validation import GpsComparison, compare_with_gps
from core.video import VideoInfo, read_frame, video_warnings

SUMMARY_FILE = "summary.json"
# How the folder begins into which results are written first; one is left over where a run was killed.
BEING_WRITTEN = ".being-written-"
FIGURES_FOLDER = "figures"
# Sharp enough for print at the width of a page, small enough for a report of a few megabytes.
FIGURE_DPI = 130
# Fewer measured frames than this are no record that could be compared with another.
LEAST_COMPARED = 4
CAPTIONS = {
    "tracked": "What was tracked, over the reference frame: the whole frame, and the target enlarged. Dots are edge "
    "points or patches, green dots ground features in use, dashed what was said to move.",
    "displacement": "Displacement from rest and rotation, with bands of two standard deviations.",
    "orbit": "Path of P1 in plan.",
    "pre_event": "Before the event: ground-stabilised displacement without drift correction, and its Fourier "
    "amplitudes.",
    "corner_sweep": "What a high-pass filter of the uncorrected displacement would leave before the event, by its "
    "corner frequency.",
    "corner_effect": "What different corner frequencies would make of the uncorrected displacement.",
    "gps": "Displacement at the antenna, and GPS.",
    "camera": "Drift and turns of the camera from their means.",
}


@dataclass(frozen=True)
class Results:
    """A finished measurement, and what is known about how it came to be.

    Attributes:
        project: what the person decided.
        folder: of the project.
        recording: measurements in raw pixels.
        solution: displacement and everything it rests on.
        gps: to compare with, where given.
        video: its file.
        info: what its container says of it.
        sha256: of each input, by its path as the project names it.
        identity: of each input, by which it is told without reading all of it whether it is still the same.
        version: of the program.
        frames_measured: in this run; the others were known from earlier ones.
        measuring_s, solving_s: how long both took.
    """

    project: Project
    folder: Path
    recording: Recording
    solution: Solution
    gps: GpsRecord | None
    video: File
    info: VideoInfo
    sha256: Mapping[str, str]
    identity: Mapping[str, str]
    version: str
    frames_measured: int
    measuring_s: float
    solving_s: float


@dataclass(frozen=True)
class GpsCheck:
    """Displacement of one target at the antenna, (F, 2), and how it compares with GPS."""

    target: str
    moved_m: Floats
    comparison: GpsComparison


def write_results(folder: Path, results: Results, progress: Progress = silent) -> dict[str, Any]:
    """Write `<target>.csv`, `summary.json`, `figures/` and `report.html` into a folder; return the summary.

    Files of targets and figures that are no longer there are removed.

    Raises:
        InputError: GPS and video cannot be compared; nothing has been written then.
    """
    check = compared_with_gps(results)
    warnings = all_warnings(results, check)
    summary = summary_of(results, check, warnings)
    figures = _draw(results, check, progress)
    histories = results.solution.histories
    with _all_or_none(folder) as made:
        for name, history in histories.items():
            write_history_csv(made / f"{name}.csv", history)
        for name, figure in figures.items():
            write_atomically(made / FIGURES_FOLDER / f"{name}.png", figure.png)
        write_report(made, _report_content(results, check=check, warnings=warnings, summary=summary, figures=figures))
        write_summary(made / SUMMARY_FILE, summary)
    _remove_stale(folder, set(histories), set(figures))
    return summary


def _is_summary(file: Path) -> bool:
    return file.name == SUMMARY_FILE


@contextmanager
def _all_or_none(folder: Path) -> Iterator[Path]:
    """Give a place to write into, whose files come into a folder at the end, the summary last, or not at all.

    Raises:
        OSError: there is no room for them, or something else is in their place.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for left_over in folder.glob(f"{BEING_WRITTEN}*"):
        shutil.rmtree(left_over, ignore_errors=True)
    try:
        with TemporaryDirectory(prefix=BEING_WRITTEN, dir=folder) as made:
            yield Path(made)
            files = sorted((file for file in Path(made).rglob("*") if file.is_file()), key=_is_summary)
            places = [folder / file.relative_to(made) for file in files]
            for place in places:
                place.parent.mkdir(exist_ok=True)
                if place.is_dir():
                    raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(place))
            for file, place in zip(files, places, strict=True):
                file.replace(place)
    except OSError as error:
        if error.errno in DISK_FULL:
            error.filename = str(folder)
        raise


def compared_with_gps(results: Results) -> GpsCheck | None:
    """Compare GPS with the target the antenna stands on, the highest one; None without GPS or measured frames.

    GPS knows no base: a target that is measured relative to another one is compared with its own whole motion.

    Raises:
        InputError: the two records share no time.
    """
    solution, settings = results.solution, results.project.inputs.gps
    if results.gps is None or settings is None or not solution.targets:
        return None
    name = max(solution.targets, key=lambda target: solution.heights_m.get(target) or 0.0)
    solved = solution.targets[name]
    if solved.history.measured.sum() < LEAST_COMPARED:
        return None
    history = filtered(solved.history, results.project.drift)
    antenna_m = solved.rest_m.mean(axis=0) if settings.at_m is None else np.array(settings.at_m)
    moved_m = displacement_at(history, rest_m=solved.rest_m, at_m=antenna_m)
    comparison = compare_with_gps(history.time_s, moved_m, results.gps, results.project.intervals_s)
    return GpsCheck(name, moved_m, comparison)


# --- warnings --------------------------------------------------------------------------------------------------------


def all_warnings(results: Results, check: GpsCheck | None) -> list[str]:
    """Return whatever an engineer must know before using the numbers, in sentences."""
    last_s = float(results.recording.time_s[-1])
    warnings = [*video_warnings(results.video.name, results.info, last_s), *results.solution.warnings]
    for target in results.project.targets:
        history = results.solution.histories[target.name]
        warnings += _measurement_warnings(history)
        warnings += _drift_warnings(results, target, history)
    if results.gps is not None and check is None:
        warnings.append("GPS was not compared, because the target was measured in too few frames.")
    if check is not None:
        warnings += _gps_warnings(results.project, check)
    return warnings


def _measurement_warnings(history: TargetHistory) -> list[str]:
    counts = history.counts()
    asked = len(history.frame) - counts["excluded"]
    if not history.measured.any():
        return [
            f"{history.name}: not one of {len(history.frame)} frames could be measured; look at the tracked frames, "
            "then correct the bands, the moving regions or the reference frame."
        ]
    if counts["lost"]:
        were = "was lost; it has" if counts["lost"] == 1 else "were lost; they have"
        return [f"{history.name}: {counts['lost']} of {asked} frames {were} no values."]
    return []


def _drift_warnings(results: Results, target: Target, history: TargetHistory) -> list[str]:
    drift = results.project.drift
    if drift.filter == "none" or not history.measured.any():
        return []
    before = unfiltered_history(results.solution, target, results.project.intervals_s)
    return [
        f"{target.name}: {sentence}"
        for sentence in filter_warnings(
            before.p1_m, history.p1_m, history.time_s, results.project.intervals_s, corner_hz=drift.corner_hz
        )
    ]


def _gps_warnings(project: Project, check: GpsCheck) -> list[str]:
    warnings = [check.comparison.message] if check.comparison.message else []
    base = next(target.relative_to for target in project.targets if target.name == check.target)
    if base is not None:
        warnings.append(
            f"GPS is compared with the whole motion of {check.target}, not with its motion relative to {base}."
        )
    return warnings


# --- summary ---------------------------------------------------------------------------------------------------------


def summary_of(results: Results, check: GpsCheck | None, warnings: list[str]) -> dict[str, Any]:
    """Return the content of `summary.json`; what could not be told is None."""
    solution, recording = results.solution, results.recording
    measuring_s = results.measuring_s
    return {
        "name": results.project.name,
        "method": results.project.method,
        "version": results.version,
        "warnings": warnings,
        "targets": {target.name: _target_summary(results, target, check) for target in results.project.targets},
        "frames": len(recording.frame),
        "duration_s": float(recording.time_s[-1]) if len(recording.time_s) else None,
        "frames_measured": results.frames_measured,
        "seconds": measuring_s,
        "frames_per_second": results.frames_measured / measuring_s if results.frames_measured else None,
        "solving_seconds": results.solving_s,
        "reference_fit": _reference_summary(solution),
        "ground_fit": _ground_summary(solution.ground),
        "self_calibration": _calibration_summary(solution.self_calibration),
        "flight": _flight_summary(solution.flight),
        "rolling_shutter": None if solution.readout is None else dataclasses.asdict(solution.readout),
        "sha256": dict(results.sha256),
        "identity": dict(results.identity),
        "settings": results.project.model_dump(mode="json"),
    }


def _target_summary(results: Results, target: Target, check: GpsCheck | None) -> dict[str, Any]:
    solution = results.solution
    return {
        **summarise(solution.histories[target.name], results.project.intervals_s),
        "height_m": solution.heights_m.get(target.name),
        "texture_patches": int(solution.targets[target.name].texture_used.sum()),
        "relative_to": target.relative_to,
        "rest_m": dict(zip(("p1", "p2"), solution.targets[target.name].rest_m.tolist(), strict=True)),
        "gps": check.comparison.summary() if check is not None and check.target == target.name else None,
    }


def _reference_summary(solution: Solution) -> dict[str, Any]:
    fit = solution.reference
    camera = None if fit.pose is None else [*(fit.pose.centre_m[:2] + fit.origin_m), fit.pose.centre_m[2]]
    return {
        "rms_px": fit.rms_px,
        "rms_m": fit.rms_m,
        "left_out_rms_px": fit.left_out_rms_px,
        "coverage": fit.coverage,
        "camera_m": camera,
        "pairs": [dataclasses.asdict(pair) for pair in fit.pairs],
    }


def _ground_summary(ground: Ground) -> dict[str, Any]:
    usable = ground.usable
    return {
        "features": len(ground.points_m),
        "features_left_out": int((~(ground.weight > 0).any(axis=0)).sum()),
        "frames": int(usable.sum()),
        "median_inliers": float(np.median(ground.inliers[usable])) if usable.any() else None,
        "least_inliers": int(ground.inliers[usable].min()) if usable.any() else None,
        "rms_px": float(np.median(ground.rms_px[usable])) if usable.any() else None,
    }


def _calibration_summary(calibration: SelfCalibration | None) -> dict[str, Any] | None:
    if calibration is None:
        return None
    return {
        "refused": calibration.refused,
        "rms_before_m": calibration.rms_before_m,
        "rms_after_m": calibration.rms_after_m,
        "corrections": [
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "correction": float(correction),
                "prior_sigma": parameter.sigma,
                "in_priors": float(in_priors),
                "sigma": float(sigma),
            }
            for parameter, correction, in_priors, sigma in zip(
                calibration.parameters, calibration.correction, calibration.in_priors, calibration.sigma, strict=True
            )
        ],
    }


def _flight_summary(flight: SmoothFlight | None) -> dict[str, Any] | None:
    """Return, per coordinate, how the camera's path was modelled: noise of a frame's pose, and how it moves."""
    if flight is None:
        return None
    return {axis: dataclasses.asdict(model) for axis, model in zip("xyz", flight.models, strict=True)}


# --- figures ---------------------------------------------------------------------------------------------------------


def _draw(results: Results, check: GpsCheck | None, progress: Progress) -> dict[str, ReportFigure]:
    """Return every figure by the name of its file, each target's under the target's name."""
    from core import figures  # takes a second to import, which commands that draw nothing should not wait for

    solution, decided = results.solution, results.project
    luma = read_frame(results.video, decided.reference_frame).luma
    drawn = {}
    for target in decided.targets:
        checked = check if check is not None and check.target == target.name else None
        drawn[f"{target.name}-tracked"] = _tracked_figure(results, target, luma)
        for name, figure in figures.target_figures(
            solution.histories[target.name],
            decided.intervals_s,
            decided.drift,
            comparison=None if checked is None else checked.comparison,
            antenna_m=None if checked is None else checked.moved_m,
        ).items():
            drawn[f"{target.name}-{name}"] = figure
    if solution.ground.poses is not None:
        centre, turns = _flight(solution, solution.ground.poses)
        drawn["camera"] = figures.camera_figure(results.recording.time_s, centre, turns)
    encoded = {}
    for number, (name, figure) in enumerate(drawn.items()):
        progress("drawing figures", number, len(drawn))
        encoded[name] = ReportFigure(
            caption=CAPTIONS[name.rpartition("-")[2]],
            png=figures.encoded(figure, dpi=FIGURE_DPI),
            width=figure.get_figwidth() / figures.PAGE_WIDTH_IN,
        )
    progress("drawing figures", len(drawn), len(drawn))
    return encoded


def _tracked_figure(results: Results, target: Target, luma: NDArray[np.uint8]) -> Any:
    from core import figures

    solution, reference = results.solution, results.recording.reference
    measured = reference.targets_raw[target.name]
    in_use = (solution.ground.weight > 0).any(axis=0)
    if measured.ndim == 2:
        corners = solution.reference.raw_from_plan(np.array(target.region_m))
        lines = {"region": np.vstack([corners, corners[:1]])}
        edges = {"region": measured}
        points = _points_of_region(solution, target, results.project.reference_frame)
    else:
        lines, points = fitted_lines(measured, solution.lens)
        edges = {name: edge.reshape(-1, 2) for name, edge in zip(LINE_NAMES, measured, strict=True)}
        texture = reference.texture_raw.get(target.name, np.empty((0, 2)))
        edges["texture"] = texture[solution.targets[target.name].texture_used]
    return figures.frame_figure(
        luma,
        lines_px=lines,
        edges_px=edges,
        points_px=points,
        ground_px=reference.ground_raw[in_use],
        regions_px=[np.array(region) for region in results.project.moving_regions_px],
        title=f"Reference frame, {target.name}",
    )


def fitted_lines(edges_raw: Floats, lens: Lens) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return L1, L2 and T1 of the reference frame as polylines (33, 2), and P1 and P2 (2,), all in raw pixels.

    Args:
        edges_raw: (3, S, 2, 2) both edges at each station, nan where not measured.
    """
    middle = lens.rays_from_raw(edges_raw.mean(axis=2))
    centre = np.nanmean(middle.reshape(-1, 2), axis=0)
    fits = [fit_line(points, np.ones(len(points)), centre) for points in middle]
    lines = LineSet(np.array([normal for normal, _ in fits]), np.array([offset for _, offset in fits]), centre)
    drawn = {}
    for name, points, normal, offset in zip(LINE_NAMES, middle, lines.normal, lines.offset, strict=True):
        along = np.array([-normal[1], normal[0]])
        reach = (points - centre) @ along
        places = np.linspace(np.nanmin(reach), np.nanmax(reach), 33)
        drawn[name] = lens.raw_from_rays(centre + offset * normal + places[:, None] * along)
    crossings = {"P1": lines.intersection(0, 2), "P2": lines.intersection(1, 2)}
    return drawn, {name: lens.raw_from_rays(crossing) for name, crossing in crossings.items()}


def _points_of_region(solution: Solution, target: Target, reference_frame: int) -> dict[str, Floats]:
    """Return P1 and P2 of a points target in raw pixels of the reference frame, where its height is known."""
    pose, height = solution.reference.pose, solution.heights_m[target.name]
    if pose is None or height is None:
        return {}
    solved = solution.targets[target.name]
    shown = solved.history.frame == reference_frame
    moved = np.stack([np.nan_to_num(each[shown]).sum(axis=0) for each in (solved.history.p1_m, solved.history.p2_m)])
    places = solved.rest_m + moved - solution.reference.origin_m
    rays = project(pose.R, pose.centre_m, np.column_stack([places, np.full(2, height)]))
    return dict(zip(("P1", "P2"), solution.lens.raw_from_rays(rays), strict=True))


def _flight(solution: Solution, poses: PoseFit) -> tuple[Floats, Floats]:
    """Return camera centres (F, 3) and turns (F, 3) about the mean attitude: roll, pitch, yaw, radians.

    Yaw is counter-clockwise seen from above, pitch about the camera's own right, roll about its level forward.
    """
    usable: Bools = solution.ground.usable & np.isfinite(poses.R).all(axis=(1, 2))
    centre = np.where(usable[:, None], poses.centre_m, np.nan)
    turns = np.full((len(usable), 3), np.nan)
    if not usable.any():
        return centre, turns
    attitude = Rotation.from_matrix(np.swapaxes(poses.R[usable], 1, 2))
    mean = attitude.mean()
    right = mean.as_matrix()[:, 0] * [1.0, 1.0, 0.0]
    right /= np.linalg.norm(right)
    up = np.array([0.0, 0.0, 1.0])
    turns[usable] = (attitude * mean.inv()).as_rotvec() @ np.stack([np.cross(up, right), right, up], axis=1)
    return centre, turns


# --- report ----------------------------------------------------------------------------------------------------------


def _report_content(
    results: Results,
    *,
    check: GpsCheck | None,
    warnings: list[str],
    summary: Mapping[str, Any],
    figures: Mapping[str, ReportFigure],
) -> ReportContent:
    solution = results.solution
    return ReportContent(
        project=results.project,
        version=results.version,
        inputs=_input_files(results),
        frames=len(results.recording.frame),
        seconds=results.measuring_s if results.frames_measured == len(results.recording.frame) else None,
        reference_fit=solution.reference,
        ground=_ground_facts(solution, summary["ground_fit"]),
        corrections=_corrections(solution),
        calibration_note=_calibration_note(solution.self_calibration),
        targets=[
            TargetReport(
                name=target.name,
                summary=summary["targets"][target.name],
                gps=check.comparison if check is not None and check.target == target.name else None,
                figures=[figure for name, figure in figures.items() if name.rpartition("-")[0] == target.name],
            )
            for target in results.project.targets
        ],
        figures=[figure for name, figure in figures.items() if name == "camera"],
        warnings=warnings,
    )


def _input_files(results: Results) -> list[InputFile]:
    inputs, time_s = results.project.inputs, results.recording.time_s
    width, height = results.solution.lens.image_size_px
    duration_s = float(time_s[-1]) if len(time_s) else 0.0
    understood = {
        "video": (inputs.video, f"{width} × {height} pixels, {len(time_s)} frames, {duration_s:.2f} s"),
        "cloud": (inputs.cloud, ""),
        "lens": (inputs.lens, _lens_words(results.solution.reference.lens)),
        "GPS": (None if inputs.gps is None else inputs.gps.file, _gps_words(results.gps)),
    }
    return [
        InputFile(part, file, results.sha256.get(file, "not known"), words)
        for part, (file, words) in understood.items()
        if file is not None
    ]


def _lens_words(lens: Lens) -> str:
    fx, fy = lens.focal_px
    rms = "" if lens.rms_px is None else f", calibrated to {lens.rms_px:.2f} px RMS"
    return f"focal lengths {fx:.1f} and {fy:.1f} px{rms}"


def _gps_words(gps: GpsRecord | None) -> str:
    return "" if gps is None else f"{len(gps.time_s)} positions, {gps.time_s[0]:g} to {gps.time_s[-1]:g} s"


def _ground_facts(solution: Solution, ground: Mapping[str, Any]) -> list[Fact]:
    facts = [Fact("frames registered", f"{ground['frames']} of {len(solution.ground.usable)}")]
    if ground["frames"]:
        facts += [
            Fact(
                "ground features in agreement",
                f"median {ground['median_inliers']:.0f}, least {ground['least_inliers']}, of {ground['features']}; "
                f"{ground['features_left_out']} of these left out throughout, as on things that stand on the ground",
            ),
            Fact("residual of a median frame", f"{ground['rms_px']:.3f} px RMS"),
        ]
    flight = solution.flight
    if flight is not None:
        kept_m = np.median(flight.sigma_m, axis=0)
        words = [
            f"{1e3 * model.noise_m:.1f} → {1e3 * kept:.1f} mm in {axis}"
            for axis, model, kept in zip("xyz", flight.models, kept_m, strict=True)
        ]
        facts.append(Fact("camera position noise, single pose → smooth flight", ", ".join(words)))
    if solution.readout is not None:
        facts.append(
            Fact(
                "rolling shutter, first to last row",
                f"{1e3 * solution.readout.readout_s:.1f} ms, {solution.readout.source}",
            )
        )
    return facts


def _corrections(solution: Solution) -> list[Correction]:
    calibration = solution.self_calibration
    if calibration is None or calibration.refused is not None:
        return []
    corrections = []
    for parameter, change, sigma, in_priors in zip(
        calibration.parameters, calibration.correction, calibration.sigma, calibration.in_priors, strict=True
    ):
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        digits = {"px": 2, "m": 3}.get(parameter.unit, 5)
        after = parameter.value + change
        corrections.append(
            Correction(
                parameter.name,
                f"{parameter.value:.{digits}f}{unit}",
                f"{after:.{digits}f} ± {sigma:.{digits}f}{unit}",
                float(in_priors),
            )
        )
    return corrections


def _calibration_note(calibration: SelfCalibration | None) -> str:
    if calibration is None:
        return "It belongs to the geometric method and did not run."
    if calibration.refused is not None:
        return f"Nothing was corrected: {calibration.refused}."
    before, after = 1e3 * calibration.rms_before_m, 1e3 * calibration.rms_after_m
    return (
        f"From the frames in which the building stands still, and from the ground. The target's apparent motion there "
        f"was {before:.2f} mm RMS with the calibration as given, and {after:.2f} mm with these corrections."
    )


# --- files -----------------------------------------------------------------------------------------------------------


def _remove_stale(folder: Path, targets: set[str], figures: set[str]) -> None:
    """Remove histories and figures that an earlier run wrote and this one did not."""
    for file in folder.glob("*.csv"):
        if file.stem not in targets and _is_history(file):
            file.unlink()
    for file in (folder / FIGURES_FOLDER).glob("*.png"):
        if file.stem not in figures:
            file.unlink()


def _is_history(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.readline().rstrip() == CSV_HEADER.encode()
