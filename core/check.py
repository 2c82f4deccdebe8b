"""Everything that keeps a project from being measured and can be told without measuring.

Each problem is one line: the file, the place in it, what is wrong and what to do. Nothing is written.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from core.cloud import Cloud, read_cloud
from core.coordinates import Floats, is_in_frame
from core.drift import corner_obstacle
from core.errors import InputError, disk_problem
from core.georeference import ReferenceFit, fit_reference
from core.gps_record import read_gps
from core.ground_plane import fit_ground_plane
from core.intervals import within
from core.lens import Lens, read_lens, require_image_size
from core.measure import make_measurer
from core.orthoimage import size_obstacle
from core.prediction import MeasureSetup
from core.progress import Progress, silent
from core.project import (
    LINE_NAMES,
    PROJECT_FILE,
    RESULTS_FOLDER,
    Band,
    Lines,
    Project,
    file_problems,
    naming_file,
    project_doubts,
    read_project,
)
from core.roof_level import distance_obstacle, height_obstacle, scale_obstacle
from core.storage import File, file_at
from core.text_files import decoded
from core.video import FrameIndex, VideoInfo, frame_index, probe, video_warnings

# Lines that cross at a smaller angle have an intersection that runs along both with every small error.
MIN_CROSSING_RAD = np.radians(20.0)
# L1 and L2 closer than a strip is wide are one line clicked twice.
MIN_P1_P2_M = 0.05
# What is narrower holds no pixel, or no two edges.
MIN_BREADTH_PX = 0.25
MIN_BAND_PX = 2.0

Result = TypeVar("Result")


@dataclass(frozen=True)
class _Inputs:
    """The inputs that could be read; None where there is none or it is a problem already told."""

    info: VideoInfo | None
    index: FrameIndex | None
    lens: Lens | None
    cloud: Cloud | None
    reference: ReferenceFit | None


def check_project(folder: Path, progress: Progress = silent, *, thorough: bool = True) -> list[str]:
    """Return each problem of a project folder, one line each with its remedy; none means that it can be measured.

    Args:
        thorough: whether to look at what takes a while too: the point cloud, a minute for a large one, and what the
            reference frame shows in the search bands.
    """
    return [_in_a_line(problem) for problem in _problems(folder, progress, thorough=thorough)]


def _in_a_line(sentence: str) -> str:
    """Return a sentence in one line, whatever breaks the names of files in it."""
    return " ".join(sentence.splitlines())


def _problems(folder: Path, progress: Progress, *, thorough: bool) -> list[str]:
    file = folder / PROJECT_FILE
    try:
        project = read_project(folder)
    except InputError as error:
        return _problems_of_file(file) or [str(error)]
    problems: list[str] = []
    if no_place := results_obstacle(folder):
        problems.append(no_place)
    inputs = _read_inputs(folder, project, problems, progress, thorough=thorough)
    problems += [f"{file}: {problem}." for problem in obstacles(project, inputs.info, inputs.index, inputs.reference)]
    for check in (_video_problems, _correspondence_problems, _target_problems, _time_problems):
        problems += [f"{file}: {problem}." for problem in check(project, inputs)]
    if thorough and not problems and inputs.reference is not None:
        setup = MeasureSetup.of(project, file_at(folder, project.inputs.video), inputs.reference)
        _tried(folder, problems, make_measurer, setup, None, inputs.index)
    return problems


def check_warnings(folder: Path) -> list[str]:
    """Return what keeps nothing from being measured but should be known before, one line each.

    None of it is told of a project or a video that cannot be read: that is a problem.
    """
    told: list[str] = []
    try:
        project = read_project(folder)
        told += [f"{folder / PROJECT_FILE}: {doubt}" for doubt in project_doubts(project)]
        video = file_at(folder, project.inputs.video)
        told += video_warnings(str(video), probe(video), float(frame_index(video).time_s[-1]))
    except InputError:
        pass
    return [_in_a_line(warning) for warning in told]


def results_obstacle(folder: Path) -> str | None:
    """Say what keeps results from being written into a project folder, in one sentence; None where nothing does."""
    results = folder / RESULTS_FOLDER
    code = None
    if os.path.lexists(results) and not results.is_dir():
        code = errno.EEXIST
    elif not os.access(results if results.is_dir() else folder, os.W_OK | os.X_OK):
        code = errno.EACCES
    return None if code is None else disk_problem(OSError(code, os.strerror(code), str(results)))


def obstacles(
    project: Project, info: VideoInfo | None, index: FrameIndex | None, reference: ReferenceFit | None
) -> Iterator[str]:
    """Say what makes it useless to begin measuring, each with its place in the file and what to do.

    Args:
        info, index: of the video, where it can be read.
        reference: the fit of the clicks, where there is one.
    """
    if project.inputs.cloud is not None and (absurd := size_obstacle(project.orthoimage)) is not None:
        yield absurd
    yield from _region_obstacles(project, info)
    if not project.targets:
        yield "targets: none; add a roof with its search bands L1, L2 and T1"
    if project.method == "geometric" and project.inputs.lens is None:
        yield 'inputs.lens: missing, but method "geometric" needs it; calibrate with rooftrack lens, or choose "paper"'
    if reference is not None and reference.is_hopeless:
        yield str(reference.contradiction)
    for number, target in enumerate(project.targets):
        camera = None if reference is None else reference.pose
        if project.method == "geometric":
            obstacle = height_obstacle(target, camera)
        else:
            obstacle = scale_obstacle(target, camera, has_lens=project.inputs.lens is not None)
        if target.lines is not None and target.kind == "lines":
            yield from _line_obstacles(target.lines, f"targets[{number}]")
            yield from _width_obstacles(target.lines, f"targets[{number}]", reference)
            apart_m = _apart_m(target.lines)
            if obstacle is None and apart_m is not None:
                obstacle = distance_obstacle(target, apart_m, camera)
        if obstacle is not None:
            yield f"targets[{number}].{obstacle}"
    if index is not None:
        yield from _time_obstacles(project, index)


def _time_obstacles(project: Project, index: FrameIndex) -> Iterator[str]:
    frames, times_s = len(index), index.time_s
    if all(project.is_excluded(number) for number in range(frames)):
        yield "excluded_frames: leave no frame of the video; take some of them out"
    if project.reference_frame >= frames:
        yield f"reference_frame: is {project.reference_frame}, but the video ends with frame {frames - 1}; lower it"
    for name, interval in project.intervals_s:
        if interval is not None and not within(times_s, interval).any():
            yield (
                f"intervals_s.{name}: [{interval[0]:g}, {interval[1]:g}] holds no frame of the video, which lasts from "
                f"0 to {times_s[-1]:.3f} s; correct it"
            )
    if project.drift.filter == "high-pass":
        obstacle = corner_obstacle(project.drift.corner_hz, times_s)
        if obstacle is not None:
            yield obstacle


def _problems_of_file(file: Path) -> list[str]:
    """Return the problems of a `project.json` one by one; none where it cannot be parsed at all."""
    try:
        document = json.loads(decoded(file.read_bytes()))
    except (OSError, ValueError, RecursionError):
        return []
    return [f"{file}: {problem}." for problem in file_problems(document)]


def _read_inputs(folder: Path, project: Project, problems: list[str], progress: Progress, *, thorough: bool) -> _Inputs:
    def tried(read: Callable[..., Result], *arguments: object) -> Result | None:
        return _tried(folder, problems, read, *arguments)

    given = project.inputs
    video = file_at(folder, given.video)
    info = tried(probe, video)
    index = tried(frame_index, video) if info else None
    lens = tried(read_lens, folder / given.lens) if given.lens else None
    if given.lens and lens and info:
        tried(_require_lens_of_video, lens, folder / given.lens, info, video)
    cloud = tried(read_cloud, folder / given.cloud, progress) if given.cloud and thorough else None
    if cloud:
        tried(_require_ground, cloud, project, folder)
    if given.gps:
        tried(read_gps, folder / given.gps.file, given.gps)
    reference = tried(_fit_reference, project, lens, info) if info and bool(lens) == bool(given.lens) else None
    return _Inputs(info=info, index=index, lens=lens, cloud=cloud, reference=reference)


def _tried(folder: Path, problems: list[str], read: Callable[..., Result], *arguments: object) -> Result | None:
    """Return what a function returns; None where it refuses, and its refusal is a problem more."""
    try:
        with naming_file(folder):
            return read(*arguments)
    except InputError as error:
        problems.append(str(error))
        return None


def _require_ground(cloud: Cloud, project: Project, folder: Path) -> None:
    try:
        fit_ground_plane(cloud, project.orthoimage.ground_z_m)
    except InputError as error:
        raise InputError(f"{folder / str(project.inputs.cloud)}: {error}") from None


def _require_lens_of_video(lens: Lens, lens_file: Path, info: VideoInfo, video: File) -> None:
    require_image_size(lens, width=info.width, height=info.height, lens_file=lens_file, video_file=video)


def _fit_reference(project: Project, lens: Lens | None, info: VideoInfo) -> ReferenceFit | None:
    size = (info.width, info.height)
    if lens is not None and lens.image_size_px != size:
        return None
    return fit_reference(project.correspondences, lens or Lens.stand_in(size), has_lens=lens is not None)


def _video_problems(project: Project, inputs: _Inputs) -> Iterator[str]:
    if inputs.index is None:
        return
    frames = len(inputs.index)
    for number, (first, last) in enumerate(project.excluded_frames):
        if last >= frames:
            yield f"excluded_frames[{number}]: [{first}, {last}] ends after the last frame, {frames - 1}; shorten it"


def _correspondence_problems(project: Project, inputs: _Inputs) -> Iterator[str]:
    if inputs.reference is not None and inputs.reference.contradiction and not inputs.reference.is_hopeless:
        yield inputs.reference.contradiction
    for pair in (pair for pair in project.correspondences if pair.enabled):
        if inputs.info and not is_in_frame(pair.frame_px, inputs.info.width, inputs.info.height):
            u, v = pair.frame_px
            size = f"{inputs.info.width} x {inputs.info.height}"
            yield f"correspondences: id {pair.id}: frame_px [{u:g}, {v:g}] is outside the {size} frame; click it again"
        if inputs.cloud and not _within_cloud(pair.ground_m, inputs.cloud):
            x, y = pair.ground_m
            yield f"correspondences: id {pair.id}: ground_m [{x:g}, {y:g}] lies outside the point cloud; click it again"


def _within_cloud(place_m: tuple[float, float], cloud: Cloud) -> bool:
    lowest, highest = cloud.extent_m
    return bool(np.all(lowest[:2] <= place_m) and np.all(place_m <= highest[:2]))


def _region_obstacles(project: Project, info: VideoInfo | None) -> Iterator[str]:
    if not project.moving_regions_px:
        yield "moving_regions_px: none, so the building would count as ground; outline all that moves"
    for number, region in enumerate(project.moving_regions_px):
        corners = np.array(region)
        if _breadth(corners) < MIN_BREADTH_PX:
            yield f"moving_regions_px[{number}]: its corners lie in a line, so it holds nothing; outline it again"
        elif info and not _overlaps_frame(corners, info):
            yield f"moving_regions_px[{number}]: lies wholly outside the frame; outline it again"


def _breadth(corners: Floats) -> float:
    """Return how far corners (N, 2) lie from the line that fits them best, the root mean square."""
    return float(np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(corners)))


def _overlaps_frame(region_px: Floats, info: VideoInfo) -> bool:
    lowest, highest = region_px.min(axis=0), region_px.max(axis=0)
    return bool(highest[0] >= 0 and highest[1] >= 0 and lowest[0] <= info.width - 1 and lowest[1] <= info.height - 1)


def _target_problems(project: Project, inputs: _Inputs) -> Iterator[str]:
    for number, target in enumerate(project.targets):
        place = f"targets[{number}]"
        for name, (x, y) in target.corners:
            extent = project.orthoimage.extent_m
            if extent and not (extent[0] <= x <= extent[2] and extent[1] <= y <= extent[3]):
                yield f"{place}.{name}: [{x:g}, {y:g}] lies outside orthoimage.extent_m; move it or enlarge the extent"
            if inputs.reference and inputs.info:
                u, v = inputs.reference.raw_from_plan(np.array([[x, y]]))[0]
                if not is_in_frame((float(u), float(v)), inputs.info.width, inputs.info.height):
                    yield f"{place}.{name}: [{x:g}, {y:g}] appears outside the reference frame; move it"


def _line_obstacles(lines: Lines, place: str) -> Iterator[str]:
    """Say where L1 and L2 do not cross T1 in two places well apart."""
    crossings = []
    for name, band in (("L1", lines.L1), ("L2", lines.L2)):
        crossing = _crossing(band, lines.T1)
        if crossing is None:
            yield f"{place}.lines: {name} and T1 run nearly the same way, so they cross nowhere well; turn one of them"
        else:
            crossings.append(crossing)
    if len(crossings) == 2 and np.hypot(*(crossings[0] - crossings[1])) < MIN_P1_P2_M:
        yield f"{place}.lines: L1 and L2 cross T1 in the same place; put them on two different roof lines"


def _apart_m(lines: Lines) -> tuple[float, float] | None:
    """Return the least and the most that P1 and P2 may lie apart within the bands, plan metres.

    None where a band ends before it crosses: it may lie beside its line, and the known distance be right.
    """
    first, second = _crossing(lines.L1, lines.T1), _crossing(lines.L2, lines.T1)
    if first is None or second is None:
        return None
    crossed = ((lines.L1, first), (lines.T1, first), (lines.L2, second), (lines.T1, second))
    if not all(_reaches(band, place) for band, place in crossed):
        return None
    apart_m, play_m = float(np.hypot(*(first - second))), (lines.L1.width_m + lines.L2.width_m) / 2
    if apart_m < MIN_P1_P2_M:
        return None
    return max(apart_m - play_m, 0.0), apart_m + play_m


def _reaches(band: Band, place: Floats) -> bool:
    """Whether a place (2,) on a band's axis, plan metres, lies between its ends."""
    start = np.array(band.from_m)
    along = np.array(band.to_m) - start
    return bool(0 <= (place - start) @ along <= along @ along)


def _width_obstacles(lines: Lines, place: str, reference: ReferenceFit | None) -> Iterator[str]:
    """Say which bands are too narrow to search; nobody would be told that a wider one was searched instead."""
    if reference is None:
        return
    for name in LINE_NAMES:
        band: Band = getattr(lines, name)
        start, end = np.array(band.from_m), np.array(band.to_m)
        aside = np.array([start[1] - end[1], end[0] - start[0]]) / np.hypot(*(end - start)) * band.width_m / 2
        left, right = reference.raw_from_plan((start + end) / 2 + np.stack([aside, -aside]))
        width_px = float(np.hypot(*(left - right)))
        if width_px < MIN_BAND_PX:
            yield (
                f"{place}.lines.{name}.width_m: {band.width_m:g} m are {width_px:.2g} pixels of the reference frame, "
                "too narrow to search; widen the band"
            )


def _crossing(line: Band, across: Band) -> Floats | None:
    """Return where two bands' axes cross (2,), plan metres; None where they are nearly parallel."""
    start, start_across = np.array(line.from_m), np.array(across.from_m)
    along, along_across = np.array(line.to_m) - start, np.array(across.to_m) - start_across
    area = along[0] * along_across[1] - along[1] * along_across[0]
    if abs(area) < np.sin(MIN_CROSSING_RAD) * np.hypot(*along) * np.hypot(*along_across):
        return None
    between = start_across - start
    return np.asarray(start + along * (between[0] * along_across[1] - between[1] * along_across[0]) / area)


def _time_problems(project: Project, inputs: _Inputs) -> Iterator[str]:
    if inputs.index is None:
        return
    times_s = inputs.index.time_s
    end_s = float(times_s[-1])
    # An interval may end with the last frame's own duration.
    last_s = end_s + float(np.median(np.diff(times_s))) if len(times_s) > 1 else end_s
    for name, interval in project.intervals_s:
        outside = interval is not None and not (interval[0] >= 0 and interval[1] <= last_s)
        if interval is not None and outside and within(times_s, interval).any():
            yield (
                f"intervals_s.{name}: [{interval[0]:g}, {interval[1]:g}] reaches outside the video, "
                f"which lasts from 0 to {end_s:.3f} s; shorten it"
            )
