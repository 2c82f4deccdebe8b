"""The renderer's truth: things appear where geometry says, the same seed gives the same picture, projects are whole."""

from __future__ import annotations

from dataclasses import replace

import av
import laspy
import numpy as np
import pytest

from core.lens import read_lens
from core.project import Project
from sample_data.catalogue import SCENES, build, compose
from sample_data.exposure import Camera
from sample_data.render import frames, write_video
from sample_data.scene import Light
from sample_data.survey import apparent_plan, finished_project, write_cloud, write_lens_file, write_truth
from sample_data.textures import Canvas


def bare(scene, texture_ground, plates=()):
    """A scene without anything that could disturb a dot: even light, no building, no objects."""
    even = replace(scene.sensor, vignetting=0.0)
    return replace(scene, ground=texture_ground, plates=tuple(plates), body=None, light=Light(), sensor=even)


def dotted(extent_m, places_m, texel_m, blur_m, *, has_edge, radius_m):
    canvas = Canvas(extent_m, texel_m, 60.0)
    for x, y in places_m:
        canvas.box((x - radius_m, y - radius_m, x + radius_m, y + radius_m), 200.0)
    return canvas.finish(blur_m, has_edge=has_edge)


def centroid(image, near, half):
    u, v = np.round(near).astype(int)
    part = image[v - half : v + half + 1, u - half : u + half + 1].astype(np.float64) - 60.0
    rows, columns = np.mgrid[v - half : v + half + 1, u - half : u + half + 1]
    return np.array([(columns * part).sum(), (rows * part).sum()]) / part.sum()


@pytest.fixture(scope="module")
def small():
    return build("small", seed=5)


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_dots_on_uneven_ground_appear_where_geometry_says(small, readout_s):
    rng = np.random.default_rng(3)
    pixel = 42.0 / 950
    grid = np.stack(np.meshgrid(np.linspace(-16, 16, 10), np.linspace(-8, 8, 6)), axis=-1).reshape(-1, 2)
    places = grid + rng.uniform(-0.3, 0.3, grid.shape)
    ground = dotted((-26, -17, 26, 17), places, pixel / 3, 0.55 * pixel, has_edge=False, radius_m=1.4 * pixel)
    scene = bare(small, ground)
    scene = replace(scene, sensor=replace(scene.sensor, readout_s=readout_s))
    camera = Camera(scene)
    time_s = 1.7
    luma, _ = camera.expose(time_s)
    world = np.column_stack((places, scene.relief.at(places)))
    expected = projected(camera, world, time_s, readout_s)
    misses = [centroid(luma, at, 6) - at for at in expected if np.all((at > 8) & (at < [951, 531]))]
    assert len(misses) > 40
    # Interpolation between texels leaves a few thousandths of a pixel (0.15 mm) at one dot, without a bias.
    assert np.std(misses, axis=0).max() < 0.005
    assert np.abs(np.mean(misses, axis=0)).max() < 0.002


def projected(camera, world, time_s, readout_s):
    """Project each point at its own row's time (two fixed-point steps suffice for a slow camera)."""
    raw = camera.project(world, time_s)
    height = camera.shape[0]
    for _ in range(3):
        when = time_s + readout_s * (raw[:, 1] - (height - 1) / 2) / (height - 1)
        raw = np.array([camera.project(point, t) for point, t in zip(world, when, strict=True)])
    return raw


@pytest.mark.parametrize("time_s", [0.4, 4.1, 4.3])
def test_dots_on_a_shaking_roof_appear_where_geometry_says(small, time_s):
    rng = np.random.default_rng(4)
    pixel = 23.7 / 950
    places = rng.uniform(-3, 3, (30, 2))
    roof = small.measured[0].plate
    texture = dotted((-4, -4, 4, 4), places, pixel / 4, 0.55 * pixel, has_edge=True, radius_m=1.4 * pixel)
    ground = dotted((-26, -17, 26, 17), [], 0.05, 0.02, has_edge=False, radius_m=0.1)
    scene = bare(small, ground, [replace(roof, texture=texture)])
    camera = Camera(scene)
    luma, _ = camera.expose(time_s)
    # The exposure is a mean over its time: so is the place that a moving dot appears at.
    instants = time_s + scene.sensor.exposure_s * np.linspace(-0.5, 0.5, 21)
    seen = []
    for instant in instants:
        plan = roof.world_from_own(places, instant)
        seen.append(camera.project(np.column_stack((plan, np.full(len(plan), roof.height_m))), instant))
    expected = np.mean(seen, axis=0)
    apart = np.linalg.norm(expected[:, None] - expected[None], axis=-1) + 1e3 * np.eye(len(expected))
    inside = np.all((expected > 10) & (expected < [949, 529]), axis=1) & (apart.min(axis=1) > 16)
    misses = np.array([centroid(luma, at, 6) - at for at in expected[inside]])
    assert len(misses) > 5
    assert np.abs(misses).max() < 0.012
    assert np.abs(misses.mean(axis=0)).max() < 0.003


TINY = (480, 270)


def test_the_same_seed_gives_the_same_picture_and_another_seed_another():
    first, again, other = (next(frames(build("eq7", seed=seed, size_px=TINY))) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert np.mean(first != other) > 0.5


@pytest.mark.parametrize("name", ["oblique", "mid_shaking", "points_roof", "two_targets", "national_grid"])
def test_projects_are_finished_and_their_bands_lie_where_the_lines_appear(name):
    scene = build(name, seed=2, size_px=TINY)
    project = finished_project(scene, Camera(scene))
    assert Project.model_validate(project.model_dump()) == project
    assert len(project.correspondences) == 20
    assert [target.name for target in project.targets] == [one.name for one in scene.measured]
    origin = np.array(scene.survey.cloud_origin_m[:2])
    for target, one in zip(project.targets, scene.measured, strict=True):
        assert target.height_m == pytest.approx(one.plate.height_m, abs=0.021)
        if target.lines is not None:
            p1 = apparent_plan(scene, one, one.lines.points_m[:1])[0] + origin
            # Half a band is 0.25 m; a person draws it to a few centimetres.
            assert distance_to_line(p1, target.lines.L1) < 0.1
            assert distance_to_line(p1, target.lines.T1) < 0.1


def distance_to_line(point, band):
    start, along = np.array(band.from_m), np.array(band.to_m) - band.from_m
    return abs(np.linalg.det([along, point - start])) / np.linalg.norm(along)


@pytest.mark.parametrize("name", ["eq5", "eq9", "windy", "tall_flexible", "mid_shaking", "portrait"])
def test_scenes_keep_their_promises(name):
    brief = SCENES[name]
    landscape = brief.size_px[0] > brief.size_px[1]
    scene = build(name, seed=1, size_px=TINY if landscape else TINY[::-1])
    moved = scene.measured[0].plate.motion(np.arange(0, scene.duration_s, 0.01))
    assert np.abs(moved[:, 0]).max() == pytest.approx(brief.peak_m, rel=0.02)
    start, end = scene.survey.intervals_s["pre_event"]
    still = scene.measured[0].plate.motion(np.linspace(start, end, 50))
    assert np.abs(still).max() < 1e-9 or brief.starts_s > 0
    R, C = scene.flight.pose(np.linspace(0, scene.duration_s, 300))
    assert np.abs(C - C[0]).max() == pytest.approx(brief.drift_m, rel=0.02)
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_truth_is_the_displacement_of_named_points(tmp_path):
    scene = build("eq9", seed=1, size_px=TINY)
    write_truth(scene, tmp_path)
    rows = np.loadtxt(tmp_path / "truth.csv", delimiter=",", skiprows=1)
    truth = np.load(tmp_path / "truth.npz")
    assert len(rows) == len(scene.frame_times())
    np.testing.assert_allclose(rows[:, 2:4], truth["roof_p1_m"], atol=1e-6)
    # P1 and P2 lie 1.22 m apart, so the rotation alone parts their displacements.
    apart = truth["roof_p1_m"] - truth["roof_p2_m"]
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), 1.22 * np.abs(2 * np.sin(rows[:, 6] / 2)), atol=1.3e-8)
    assert rows[-60:, 2].mean() == pytest.approx(0.22, abs=0.001)


def test_the_same_seed_gives_the_same_file(tmp_path):
    scene = build("small", seed=2, size_px=(256, 144), duration_s=0.8)
    for name in ("first.mp4", "second.mp4"):
        write_video(scene, tmp_path / name)
    assert (tmp_path / "first.mp4").read_bytes() == (tmp_path / "second.mp4").read_bytes()


def test_a_turned_video_is_flagged_and_stands_upright(tmp_path):
    brief = replace(SCENES["portrait"], pre_event_s=0.1, event_s=0.1, post_event_s=0.1, size_px=(270, 480))
    scene = compose("portrait", brief, 1)
    write_video(scene, tmp_path / "video.mp4", threads=1)
    with av.open(str(tmp_path / "video.mp4")) as container:
        decoded = [(frame.to_ndarray(format="gray"), frame.rotation) for frame in container.decode(video=0)]
    assert len(decoded) == len(scene.frame_times())
    stored, rotation = decoded[0]
    assert stored.shape == (270, 480)
    upright = np.rot90(stored, rotation // 90)
    rendered = next(frames(scene))[:480]
    assert np.abs(upright.astype(int) - rendered).mean() < 4


def test_uneven_timestamps_survive_the_container(tmp_path):
    brief = replace(SCENES["variable_rate"], pre_event_s=0.2, event_s=0.2, post_event_s=0.2, size_px=(128, 96))
    scene = compose("variable_rate", brief, 1)
    write_video(scene, tmp_path / "video.mp4", threads=1)
    with av.open(str(tmp_path / "video.mp4")) as container:
        stream = container.streams.video[0]
        times = sorted(float(frame.pts * stream.time_base) for frame in container.decode(stream))
    np.testing.assert_allclose(np.array(times) - times[0], scene.frame_times(), atol=1e-4)
    assert np.std(np.diff(times)) > 1e-3


def test_lens_file_and_cloud_can_be_read_and_are_nearly_right(tmp_path):
    scene = build("national_grid", seed=1, size_px=TINY)
    write_lens_file(scene, tmp_path / "lens.yaml")
    lens = read_lens(tmp_path / "lens.yaml")
    assert lens.focal_px == pytest.approx(scene.lens.focal_px, rel=4 * 6e-4)
    assert lens.centre_px == pytest.approx(scene.lens.centre_px, abs=4 * 1.5)
    scene = replace(scene, survey=replace(scene.survey, cloud_points=5_000))
    write_cloud(scene, tmp_path / "site.laz")
    cloud = laspy.read(tmp_path / "site.laz")
    height = np.asarray(cloud.z) - scene.survey.cloud_origin_m[2]
    assert np.median(height) == pytest.approx(0.0, abs=0.05)
    assert np.sum(np.abs(height - 18.3) < 0.05) > 50
