from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from core.calibration import LAG
from core.camera import fit_poses
from core.coordinates import Bools, Floats
from core.errors import InputError
from core.ground_poses import fit_with_relief, solve_ground
from core.lens import Lens
from core.measurements import Recording
from core.project import Project
from core.relief import Relief
from core.results import Status, TargetHistory
from core.solution import Solution
from core.solve import solve
from core.solve_geometric import solve_geometric
from core.uncertainty import LEAST_STILL
from tests import exact_scene as scene

NOISE_PX = 0.05


def solved(recording: Recording, lens: Lens = scene.LENS, **changes: Any) -> Solution:
    return solve_geometric(recording, scene.project_document(**changes), lens)


def error_m(history: TargetHistory) -> Floats:
    """(F, 2) of P1, both counted from the mean of the stationary part."""
    still = history.time_s < 2.9
    true = scene.truth(len(history.frame)).p1_m
    return (history.p1_m - history.p1_m[still].mean(axis=0)) - (true - true[still].mean(axis=0))


def rms_mm(history: TargetHistory) -> float:
    return 1e3 * float(np.sqrt(np.nanmean(error_m(history) ** 2)))


def corrections(solution: Solution) -> dict[str, float]:
    found = solution.self_calibration
    assert found is not None
    assert found.refused is None
    return dict(zip([parameter.name for parameter in found.parameters], found.correction.tolist(), strict=True))


def seen_later(sample: Callable[[float], Floats], delay_s: Floats, frame: int) -> Floats:
    """Raw pixels (..., 2) of points, each seen `delay_s` (...) after a frame's time stamp, through three views."""
    span = max(float(np.abs(delay_s).max()), 1e-9)
    x = (delay_s / span)[..., None]
    before, now, after = (sample(frame + share * span * scene.RATE_HZ) for share in (-1, 0, 1))
    return now + 0.5 * x * (after - before) + 0.5 * x**2 * (after - 2 * now + before)


def ground_at(moment: float) -> Floats:
    places = scene.ground_places()
    return scene.seen(moment, np.column_stack([places, np.zeros(len(places))]))


def roof_at(moment: float) -> Floats:
    return scene.seen(moment, scene.on_roof(moment))


def row_delay_s(raw: Floats, readout_s: float) -> Floats:
    height = scene.SIZE[1]
    return readout_s * (raw[..., 1] - (height - 1) / 2) / (height - 1)


# --- exact -----------------------------------------------------------------------------------------------------------


def test_exact_measurements_give_exact_displacement() -> None:
    solution = solved(scene.recording())
    assert rms_mm(solution.histories["roof"]) < 0.02
    assert (solution.histories["roof"].status == Status.OK).all()


def test_residual_displacement_stays() -> None:
    history = solved(scene.recording(NOISE_PX)).histories["roof"]
    rest = history.p1_m[history.time_s > 6.5].mean(axis=0)
    np.testing.assert_allclose(rest, [scene.RESIDUAL_M, 0.0], atol=1.5e-3)


def test_rest_is_where_points_lie_before_the_event_whatever_the_reference_frame_shows() -> None:
    recording = scene.recording()
    shaken = int(np.argmax(np.abs(scene.truth().p1_m[:, 0])))
    ground, roof = recording.ground_raw[shaken], recording.targets_raw["roof"][shaken]
    assert np.abs(scene.truth().p1_m[shaken, 0]) > 0.05
    still = solved(recording).targets["roof"].rest_m
    later = replace(recording, reference=replace(recording.reference, ground_raw=ground, targets_raw={"roof": roof}))
    pixels = scene.seen(shaken, np.column_stack([np.array(scene.CLICKS, dtype=float), np.zeros(len(scene.CLICKS))]))
    pairs = [
        pair.model_copy(update={"frame_px": tuple(pixel)})
        for pair, pixel in zip(scene.project_document().correspondences, pixels.tolist(), strict=True)
    ]
    solution = solved(later, reference_frame=shaken, correspondences=pairs)
    np.testing.assert_allclose(solution.targets["roof"].rest_m, still, atol=2e-3)
    assert rms_mm(solution.histories["roof"]) < 0.1


def as_points(lines: Recording) -> tuple[Recording, dict[str, Any]]:
    """The recording of a textured roof whose patches lie where edges of lines do, and what the project says of it."""
    patches = lines.targets_raw["roof"].reshape(scene.FRAMES, -1, 2)
    reference = replace(lines.reference, targets_raw={"roof": lines.reference.targets_raw["roof"].reshape(-1, 2)})
    corners = [(-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0)]
    region = [tuple(np.array(corner) + scene.ROOF_M + scene.SITE_M) for corner in corners]
    target = {"name": "roof", "kind": "points", "height_m": scene.HEIGHT_M, "region_m": region}
    return replace(lines, reference=reference, targets_raw={"roof": patches}), {"targets": [target]}


def test_a_textured_roof_seen_roughly_is_measured_with_a_larger_standard_deviation() -> None:
    recording, textured = as_points(scene.recording(0.02))
    patches = recording.targets_raw["roof"]
    rough = 60
    noise = np.random.default_rng(7).normal(scale=0.2, size=patches.shape[1:])
    patches = patches + np.where(np.arange(scene.FRAMES) == rough, 1.0, 0.0)[:, None, None] * noise
    history = solved(replace(recording, targets_raw={"roof": patches}), **textured).histories["roof"]
    assert (history.status == Status.OK).all()
    usual = np.median(history.p1_sigma_m, axis=0)
    assert (history.p1_sigma_m[rough] > 2.0 * usual).all()
    assert (np.abs(history.p1_m[rough] - scene.truth().p1_m[rough]) < 4.0 * history.p1_sigma_m[rough] + 1e-3).all()


@pytest.mark.parametrize("kept", [0, 3, 40])
def test_two_lines_that_are_not_quite_parallel_fix_nothing(kept: int) -> None:
    recording = scene.recording(NOISE_PX)
    roof = recording.targets_raw["roof"].copy()
    roof[kept:, 2] = np.nan
    history = solved(replace(recording, targets_raw={"roof": roof})).histories["roof"]
    assert (history.status[kept:] == Status.LOST).all()
    assert np.isfinite(history.p1_sigma_m[history.measured]).all()


def test_a_roof_above_the_camera_is_refused() -> None:
    document = scene.project_document()
    roof = {**document.targets[0].model_dump(by_alias=True), "height_m": 90.0}
    with pytest.raises(InputError, match=r"height_m: 90, but by the clicks the camera hovers \d+\.\d m above"):
        solved(scene.recording(), targets=[roof])


def test_a_distance_that_is_not_the_known_one_is_told() -> None:
    document = scene.project_document()
    roof = document.targets[0].model_dump(by_alias=True)
    distance_m = float(np.linalg.norm(np.subtract(*solved(scene.recording()).targets["roof"].rest_m)))
    right, wrong = (
        solved(scene.recording(), targets=[{**roof, "p1_p2_m": share * distance_m}]).warnings for share in (1.01, 1.05)
    )
    assert not any("p1_p2_m" in warning for warning in right)
    assert any("P1 and P2 of roof lie" in warning and "check height_m, the lens" in warning for warning in wrong)


def test_a_pre_event_in_which_the_building_moves_is_told() -> None:
    recording = scene.recording(NOISE_PX)
    assert not any("steadily" in warning for warning in solved(recording).warnings)
    shaken = solved(recording, intervals_s={"pre_event": [0.0, 5.0], "event": [5.0, 6.0], "residual": [6.5, 7.9]})
    assert any("P1 of roof moves by" in warning and "steadily" in warning for warning in shaken.warnings)


@pytest.mark.filterwarnings("error")
def zoomed(recording: Recording, factor: float) -> Recording:
    """The recording as a lens shows it whose focal length changes by a factor in mid-clip, within a second."""
    ahead = np.clip(recording.time_s - recording.time_s[len(recording.time_s) // 2], 0.0, 1.0)
    zoom = 1.0 + (factor - 1.0) * ahead

    def enlarged(raw: Floats) -> Floats:
        und = scene.LENS.undistort(raw) - scene.LENS.centre_px
        return scene.LENS.distort(zoom.reshape(-1, *[1] * (raw.ndim - 1)) * und + scene.LENS.centre_px)

    targets = {name: enlarged(raw) for name, raw in recording.targets_raw.items()}
    return replace(recording, ground_raw=enlarged(recording.ground_raw), targets_raw=targets)


@pytest.mark.parametrize("kind", ["lines", "points"])
def test_a_zoom_in_mid_clip_is_told_by_a_roof_that_seems_to_grow(kind: str) -> None:
    steady = scene.recording(NOISE_PX)
    changes = {}
    if kind == "points":
        steady, changes = as_points(steady)
    height, roof = scene.pose(0).centre_m[2], scene.HEIGHT_M
    for factor in (1.01, 0.99):
        told = [words for words in solved(zoomed(steady, factor), **changes).warnings if "grow" in words]
        assert len(told) == 1
        percent = 100 * abs(factor - 1) * roof / (height - roof)
        assert float(re.search(r"by ([\d.]+) %", told[0])[1]) == pytest.approx(percent, abs=0.11)
    assert not any("grow" in words for words in solved(steady, **changes).warnings)


def test_a_residual_in_which_the_building_shakes_is_told() -> None:
    recording = scene.recording(NOISE_PX)
    assert not any("residual" in warning for warning in solved(recording).warnings)
    shaken = solved(recording, intervals_s={"pre_event": [0.0, 2.9], "event": [3.0, 4.0], "residual": [3.5, 5.0]})
    assert any("P1 of roof moves by" in told and "choose a later residual" in told for told in shaken.warnings)


def test_a_pre_event_of_a_few_frames_is_told() -> None:
    told = solved(scene.recording(NOISE_PX), intervals_s={"pre_event": [0.0, 0.2]}).warnings
    assert any("roof was measured in only" in warning and "choose a longer pre_event" in warning for warning in told)


def test_intervals_that_cannot_be_meant_are_told() -> None:
    document = scene.project_document(intervals_s={"pre_event": [0.0, 3.5], "event": [3.0, 6.0]})
    told = solve(scene.recording(NOISE_PX), document, scene.LENS).warnings
    assert told[0] == "intervals_s: pre_event and event share 0.5 s; let one end before the other begins."


def test_a_height_that_the_cloud_does_not_show_is_told() -> None:
    recording, document = scene.recording(NOISE_PX), scene.project_document()
    west, south = scene.SITE_M - 30.0
    x, y = np.meshgrid(west + 0.25 * np.arange(240), south + 0.25 * np.arange(240))
    middle = scene.SITE_M + scene.ROOF_M
    on_roof = (np.abs(x - middle[0]) < 4.0) & (np.abs(y - middle[1]) < 4.0)
    for wrong_by_m in (0.0, 1.0):
        standing = np.where(on_roof, scene.HEIGHT_M + wrong_by_m, 0.0)
        relief = Relief(float(west), float(south), 0.25, np.zeros(x.shape), standing)
        warnings = solve_geometric(recording, document, scene.LENS, relief).warnings
        assert any("but the point cloud shows it" in warning for warning in warnings) == (wrong_by_m > 0)


def test_a_pre_event_in_which_nothing_was_measured_is_told() -> None:
    recording = scene.recording(NOISE_PX)
    roof = recording.targets_raw["roof"].copy()
    roof[recording.time_s < 2.95] = np.nan
    solution = solved(replace(recording, targets_raw={"roof": roof}), intervals_s={"pre_event": [0.0, 2.9]})
    assert any("roof was not measured in pre_event" in warning for warning in solution.warnings)
    assert solution.self_calibration is not None
    assert solution.self_calibration.refused == "no target was measured while the building stands still"
    assert (solution.histories["roof"].status[recording.time_s > 3.0] == Status.OK).all()


# --- steady features count more --------------------------------------------------------------------------------------


def test_features_on_grass_hardly_count() -> None:
    recording = scene.recording(0.02)
    noise = np.random.default_rng(2).normal(scale=0.5, size=recording.ground_raw.shape)
    grass = np.arange(recording.ground_raw.shape[1]) % 5 < 2
    noise[:, ~grass] = 0.0
    rough = replace(recording, ground_raw=recording.ground_raw + noise)
    project = scene.project_document()
    reference = fit_with_relief(project, scene.LENS, None)
    assert reference.pose is not None
    ground = solve_ground(rough, scene.LENS, reference.pose, origin_m=reference.origin_m, relief=None)
    weight = ground.known_poses.weight
    assert weight[:, grass].mean() < 0.05 * weight[:, ~grass].mean()
    # They are not outliers for that: what a person is shown as rejected is what disagrees for its own standards.
    assert (ground.weight[:, grass] > 0.1).mean() > 0.9
    alone = solve_ground(recording, scene.LENS, reference.pose, origin_m=reference.origin_m, relief=None)
    apart = np.abs(ground.known_poses.centre_m - alone.known_poses.centre_m).mean()
    assert apart < 0.3 * _equally_weighted_error(rough, alone.known_poses.centre_m, project)


def _equally_weighted_error(recording: Recording, centre_m: Floats, project: Project) -> float:
    reference = fit_with_relief(project, scene.LENS, None)
    assert reference.pose is not None
    ground = solve_ground(recording, scene.LENS, reference.pose, origin_m=reference.origin_m, relief=None)
    rays = scene.LENS.rays_from_raw(recording.ground_raw)
    equal = fit_poses(rays, np.ones(rays.shape[:2]), ground.points_m, reference.pose, robust=False)
    return float(np.abs(equal.centre_m - centre_m).mean())


# --- what stands on the ground ----------------------------------------------------------------------------------------

CONTAINER_M = 2.6


def on_containers() -> Bools:
    """(N,) which ground features lie in the west of the site, where the recording below has containers."""
    return np.asarray(scene.ground_places()[:, 0] < -15.0)


def with_containers(noise_px: float, frames: int) -> Recording:
    """The exact scene, but for features in the west that lie on containers where a person sees ground."""
    height = np.where(on_containers(), CONTAINER_M, 0.0)
    eye = scene.pose(0).centre_m
    share = (height / eye[2])[:, None]
    places = np.column_stack([(1 - share) * scene.ground_places() + share * eye[:2], height])
    seen = np.array([scene.seen(frame, places) for frame in range(frames)])
    noise = np.random.default_rng(8).normal(scale=noise_px, size=seen.shape)
    noise[0] = 0.0
    return replace(scene.recording(noise_px, frames), ground_raw=seen + noise)


def test_what_no_cloud_shows_is_told_from_the_ground_by_how_it_moves() -> None:
    recording = with_containers(0.02, scene.FRAMES)
    assert 20 < on_containers().sum() < 0.3 * len(on_containers())
    solution = solved(recording)
    used = solution.ground.known_poses.weight.max(axis=0) > 0
    assert not used[on_containers()].any()
    assert used[~on_containers()].mean() > 0.95
    without = recording.ground_raw.copy()
    without[:, on_containers()] = np.nan
    alone = solved(replace(recording, ground_raw=without))
    assert rms_mm(solution.histories["roof"]) < 1.1 * rms_mm(alone.histories["roof"])


def test_what_the_cloud_shows_is_no_ground_even_if_the_camera_hardly_moves() -> None:
    recording = with_containers(0.3, 6)
    cell = 0.5
    west, south = scene.SITE_M - [30.0, 20.0]
    x = west + cell * np.arange(120)
    standing = np.broadcast_to(np.where(x < scene.SITE_M[0] - 13.0, CONTAINER_M, 0.0), (80, 120))
    relief = Relief(float(west), float(south), cell, np.zeros((80, 120)), standing)
    reference = fit_with_relief(scene.project_document(), scene.LENS, relief)
    assert reference.pose is not None
    shown = []
    for known in (None, relief):
        ground = solve_ground(recording, scene.LENS, reference.pose, origin_m=reference.origin_m, relief=known)
        shown.append(ground.known_poses.weight.max(axis=0) > 0)
    assert shown[0][on_containers()].all()
    assert not shown[1][on_containers()].any()


def test_a_camera_that_never_moves_tells_nothing_about_heights() -> None:
    recording = scene.recording(0.0, 3)
    still = replace(recording, ground_raw=np.repeat(recording.ground_raw[:1], 3, axis=0))
    reference = fit_with_relief(scene.project_document(), scene.LENS, None)
    assert reference.pose is not None
    ground = solve_ground(still, scene.LENS, reference.pose, origin_m=reference.origin_m, relief=None)
    assert (ground.known_poses.weight.max(axis=0) > 0).all()


def test_a_cloud_in_which_everything_stands_is_not_believed() -> None:
    recording = scene.recording(0.02, 6)
    everywhere = np.full((200, 200), CONTAINER_M)
    relief = Relief(*(scene.SITE_M - 50.0).tolist(), 0.5, np.zeros((200, 200)), everywhere)
    reference = fit_with_relief(scene.project_document(), scene.LENS, None)
    assert reference.pose is not None
    ground = solve_ground(recording, scene.LENS, reference.pose, origin_m=reference.origin_m, relief=relief)
    assert ground.usable.all()


# --- frames whose ground is a repetition ------------------------------------------------------------------------------


def test_frames_that_repeat_the_ground_of_the_reference_frame_are_lost() -> None:
    recording = scene.recording(0.3)
    ground = recording.ground_raw.copy()
    repeated = slice(1, 6)
    ground[0] = recording.reference.ground_raw
    ground[repeated] = recording.reference.ground_raw + 0.02 * np.sin(np.arange(5))[:, None, None]
    history = solved(replace(recording, ground_raw=ground)).histories["roof"]
    assert (history.status[repeated] == Status.LOST).all()
    assert np.isnan(history.p1_m[repeated]).all()
    # The reference frame itself is no repetition, and what follows is measured.
    assert (np.delete(history.status, np.arange(1, 6)) != Status.LOST).all()


def test_a_coarse_fit_elsewhere_makes_no_repetition_of_good_frames() -> None:
    # With a wrong lens and much drift, features fit the better the nearer the view is to the reference frame's.
    recording = scene.recording(0.05)
    wander = np.linspace(0.0, 1.0, len(recording.frame))[:, None, None]
    bent = 0.9 * np.random.default_rng(7).normal(size=(1, *recording.ground_raw.shape[1:]))
    history = solved(replace(recording, ground_raw=recording.ground_raw + wander * bent)).histories["roof"]
    assert (history.status == Status.OK).all()


def test_a_clean_view_like_the_reference_frame_is_no_repetition() -> None:
    recording = scene.recording(0.05)
    ground = recording.ground_raw.copy()
    true = scene.recording().ground_raw
    ground[:20] = true[:20] + 1e-4
    history = solved(replace(recording, ground_raw=ground)).histories["roof"]
    assert (history.status == Status.OK).all()


# --- self-calibration ------------------------------------------------------------------------------------------------


def wrong_lens() -> Lens:
    K = scene.LENS.camera_matrix.copy()
    K[0, 0] *= 1 + 9e-4
    K[1, 1] *= 1 + 9e-4
    K[:2, 2] += [2.0, -1.5]
    return replace(scene.LENS, camera_matrix=K)


def test_a_wrong_lens_is_corrected_from_what_stands_still() -> None:
    solution = solved(scene.recording(3e-4), wrong_lens())
    found = solution.self_calibration
    assert found is not None
    assert found.rms_after_m < 0.5 * found.rms_before_m
    assert rms_mm(solution.histories["roof"]) < 1.0
    # Its own uncertainty covers what it misses: the truth lies within three standard deviations.
    off = [found.correction[2] + 2.0, found.correction[3] - 1.5]
    assert (np.abs(off) < 3 * found.sigma[2:4]).all()


def test_a_known_distance_corrects_the_scale() -> None:
    # A short and noisy pre-event, which leaves the scale at the roof half open; lens and height are wrong.
    off = 1.0 + 2 * scene.LENS.sigma.focal_relative
    matrix = scene.LENS.camera_matrix * np.array([[off, 1.0, 1.0], [1.0, off, 1.0], [1.0, 1.0, 1.0]])
    lens = replace(scene.LENS, camera_matrix=matrix)
    roof = scene.project_document().targets[0].model_dump(by_alias=True)
    distance_m = float(np.linalg.norm(np.subtract(*solved(scene.recording()).targets["roof"].rest_m)))

    def scale_error(known_m: float | None) -> float:
        target = {**roof, "height_m": scene.HEIGHT_M + 0.04, "p1_p2_m": known_m}
        found = solved(scene.recording(0.3), lens, targets=[target], intervals_s={"pre_event": [0.0, 1.2]})
        return abs(float(np.linalg.norm(np.subtract(*found.targets["roof"].rest_m))) / distance_m - 1.0)

    assert scale_error(distance_m) < 0.5 * scale_error(None)


def test_the_rest_after_the_event_calibrates_too() -> None:
    intervals = {"pre_event": None, "event": (3.0, 6.0), "residual": (6.2, 7.9)}
    with_rest = solved(scene.recording(0.02), wrong_lens(), intervals_s=intervals)
    assert corrections(with_rest)["cx"] < -0.3
    without = solved(scene.recording(0.02), wrong_lens(), intervals_s={"pre_event": None, "residual": None})
    assert without.self_calibration is not None
    assert "no interval" in str(without.self_calibration.refused)


def test_a_building_that_still_trembles_after_the_event_calibrates_nothing() -> None:
    intervals = {"pre_event": (0.0, 2.9), "event": (5.5, 7.9), "residual": (3.2, 5.4)}  # in the midst of shaking
    misled = solved(scene.recording(0.02), intervals_s=intervals)
    usual = solved(scene.recording(0.02), intervals_s={"pre_event": (0.0, 2.9), "event": (3.0, 7.9)})
    np.testing.assert_allclose(corrections(misled)["cx"], corrections(usual)["cx"], atol=0.15)


def test_ground_that_lags_behind_is_brought_up_to_time() -> None:
    lag_s, steady = 0.03, scene.recording(0.15)
    noise = steady.ground_raw - scene.recording().ground_raw
    late = np.stack([ground_at(frame - lag_s * scene.RATE_HZ) for frame in range(scene.FRAMES)])
    solution = solved(replace(steady, ground_raw=late + noise))
    assert corrections(solution)[LAG] == pytest.approx(lag_s, abs=0.006)
    assert rms_mm(solution.histories["roof"]) < 1.3 * rms_mm(solved(steady).histories["roof"])
    assert abs(corrections(solved(steady))[LAG]) < 0.006


# --- rolling shutter -------------------------------------------------------------------------------------------------

READOUT_S = 0.03


def rolled() -> Recording:
    """What a rolling shutter records: each point at the moment its own row is read."""
    recording = scene.recording(NOISE_PX)
    exact = scene.recording()
    ground, roof = np.empty_like(exact.ground_raw), np.empty_like(exact.targets_raw["roof"])
    for frame in range(scene.FRAMES):
        ground[frame] = seen_later(ground_at, row_delay_s(exact.ground_raw[frame], READOUT_S), frame)
        roof[frame] = seen_later(roof_at, row_delay_s(exact.targets_raw["roof"][frame], READOUT_S), frame)
    return replace(
        recording,
        ground_raw=ground + recording.ground_raw - exact.ground_raw,
        targets_raw={"roof": roof + recording.targets_raw["roof"] - exact.targets_raw["roof"]},
    )


def test_rows_read_one_after_another_are_brought_to_one_moment() -> None:
    recording = rolled()
    known = solved(recording, replace(scene.LENS, readout_s=READOUT_S))
    best = rms_mm(solved(scene.recording(NOISE_PX)).histories["roof"])
    assert rms_mm(known.histories["roof"]) < 1.4 * best
    assert known.readout is not None
    assert known.readout.source == "lens file"


def test_a_rolling_shutter_is_seen_in_the_footage() -> None:
    found = solved(rolled()).readout
    assert found is not None
    assert found.sigma_s is not None
    assert found.readout_s == pytest.approx(READOUT_S, abs=3 * found.sigma_s)
    assert "estimated" in found.source


def test_a_global_shutter_stays_one_and_says_how_sure_it_is() -> None:
    found = solved(scene.recording(NOISE_PX)).readout
    assert found is not None
    assert found.readout_s == 0.0
    assert "none longer than" in found.source


# --- error bars ------------------------------------------------------------------------------------------------------


def test_error_bars_grow_where_the_roof_is_seen_worse() -> None:
    recording = scene.recording(NOISE_PX)
    random = np.random.default_rng(7)
    roof = recording.targets_raw["roof"].copy()
    shaking = (recording.time_s > 3.0) & (recording.time_s < 6.0)
    pieces = np.repeat(random.normal(scale=0.3, size=(shaking.sum(), 3, 8, 1, 2)), scene.STATIONS // 8, axis=2)
    roof[shaking] += pieces
    history = solved(replace(recording, targets_raw={"roof": roof})).histories["roof"]
    before = np.median(history.p1_sigma_m[recording.time_s < 2.5])
    during = np.median(history.p1_sigma_m[(recording.time_s > 3.8) & (recording.time_s < 5.2)])
    assert during > 2.0 * before


@pytest.mark.parametrize("frames", [6, 20])
def test_error_bars_of_a_few_frames_hold_what_single_poses_err_by(frames: int) -> None:
    """Too few to smooth the flight: the camera's noise stays in each frame, and no rest says how large it is."""
    recording = scene.recording(0.01, frames)
    ground = recording.ground_raw.copy()
    ground[1:] += np.random.default_rng(4).normal(scale=0.3, size=ground[1:].shape)
    history = solved(replace(recording, ground_raw=ground), intervals_s={}).histories["roof"]
    ratio = ((history.p1_m - scene.truth(frames).p1_m) / history.p1_sigma_m)[1:]
    # This noise is new in each frame; they are widened for noise that is not, which so few frames cannot show.
    widened = np.sqrt(LEAST_STILL / frames)
    assert 0.5 < widened * np.sqrt((ratio**2).mean()) < 1.6


def test_a_line_of_which_hardly_anything_is_seen_leaves_its_frame_lost() -> None:
    recording = scene.recording(NOISE_PX)
    roof = recording.targets_raw["roof"].copy()
    roof[50, 2, 3:] = np.nan  # T1 alone says where the roof is along L1 and L2
    roof[60, 0] = np.nan  # L2 still says what L1 did
    history = solved(replace(recording, targets_raw={"roof": roof})).histories["roof"]
    assert history.status[50] == Status.LOST
    assert np.isnan(history.p1_m[50]).all()
    assert history.status[60] == Status.WEAK
    assert np.abs(error_m(history)[60]).max() < 5e-3


@pytest.mark.parametrize("method", ["geometric", "paper"])
def test_what_a_person_rejected_decides_nothing(method: str) -> None:
    recording = replace(scene.recording(NOISE_PX), method=method)
    rejected = slice(5, 31)
    disturbed = recording.targets_raw["roof"].copy()
    disturbed[rejected] += np.linspace(0.0, 6.0, 26)[:, None, None, None, None]
    ground = recording.ground_raw.copy()
    ground[rejected] += np.random.default_rng(2).normal(scale=0.5, size=ground[rejected].shape)
    project = scene.project_document(excluded_frames=[(5, 30)], method=method)
    left, other = (
        solve(one, project, scene.LENS).histories["roof"]
        for one in (recording, replace(recording, targets_raw={"roof": disturbed}, ground_raw=ground))
    )
    assert set(left.status[rejected]) == {Status.EXCLUDED.value}
    np.testing.assert_array_equal(other.p1_m, left.p1_m)
    np.testing.assert_array_equal(other.p1_sigma_m, left.p1_sigma_m)
