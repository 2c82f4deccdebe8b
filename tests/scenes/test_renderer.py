"""The renderer's truth: things appear where geometry says, the same seed gives the same picture, projects are whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sample_data.catalogue import build
from sample_data.exposure import Camera
from sample_data.scene import Light
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
