"""What else can happen in a scene: passers-by, birds, dust, clouds, flicker, gusts, another roof, a table to measure.

Each takes a scene, the brief it was composed from and a random generator, and returns the scene with one thing more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sample_data import painting
from sample_data.brief import Brief
from sample_data.flight import Gust
from sample_data.scene import Measured, Plate, RoofLines, Scene
from sample_data.shaking import Motion
from sample_data.textures import Texture

Floats = NDArray[np.float64]
Rng = np.random.Generator

PIXEL_BLUR_PX = 0.55
"""What lens and pixel together smear a point to: one standard deviation, pixels."""


@dataclass(frozen=True)
class Fineness:
    """How fine a texture at some height must be for a camera: texel and blur, metres."""

    texel_m: float
    blur_m: float

    @classmethod
    def at(cls, brief: Brief, height_m: float, texels_per_pixel: float = 3.0) -> Fineness:
        """Return texels a few times finer than pixels at a height above the ground."""
        pixel = (brief.altitude_m - height_m) / brief.focal_px
        return cls(pixel / texels_per_pixel, PIXEL_BLUR_PX * pixel)

    @property
    def arguments(self) -> dict[str, float]:
        """As keyword arguments of the painting functions."""
        return {"texel_m": self.texel_m, "blur_m": self.blur_m}


def passing(velocity_m_s: tuple[float, float], when_s: float) -> Motion:
    """Return the motion of something that goes straight on and is at its centre at a time."""
    velocity = np.array([*velocity_m_s, 0.0])
    return lambda time_s: (np.atleast_1d(time_s) - when_s)[:, None] * velocity


def _middle_s(scene: Scene, brief: Brief) -> float:
    """Return a time in the strongest shaking."""
    return min(brief.pre_event_s + 0.4 * brief.event_s - brief.starts_s, 0.6 * scene.duration_s)


def _with_plate(scene: Scene, plate: Plate) -> Scene:
    return replace(scene, plates=(*scene.plates, plate))


def crossing_person_and_car(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """A car drives across the ground and two people walk over it, all through the event."""
    when = _middle_s(scene, brief)
    side = 0.33 * brief.size_px[1] * brief.altitude_m / brief.focal_px
    car = painting.paint_car(rng, **Fineness.at(brief, 1.45).arguments)
    scene = _with_plate(scene, Plate("passing car", 1.45, car, (0.0, -side), motion=passing((4.5, 0.1), when)))
    for number, (at, velocity) in enumerate((((0.0, side), (-1.3, 0.2)), ((-9.5, 0.0), (0.15, 1.4)))):
        person = painting.paint_blob(rng, 0.28, rng.uniform(30, 210), **Fineness.at(brief, 1.7).arguments)
        motion = passing(velocity, when + rng.uniform(-1, 1))
        scene = _with_plate(scene, Plate(f"passing person {number}", 1.7, person, at, motion=motion))
    return scene


def bird_over_line(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """A bird flies over the roof lines, once slowly in the event and once before it."""
    roof = scene.measured[0].plate
    height = brief.roof_m + 5.0
    for number, (when, velocity) in enumerate(
        ((0.4 * brief.pre_event_s, (5.0, 2.5)), (_middle_s(scene, brief), (-3.0, 4.0)))
    ):
        bird = painting.paint_blob(rng, 0.33, (30.0, 235.0)[number], **Fineness.at(brief, height).arguments)
        at = _above(scene, roof, np.array([0.3, 0.4]), height)
        scene = _with_plate(scene, Plate(f"passing bird {number}", height, bird, at, motion=passing(velocity, when)))
    return scene


def _above(scene: Scene, roof: Plate, own_m: Floats, height_m: float) -> tuple[float, float]:
    """Return where something at a height must be to hide a place on the roof from the camera."""
    plan = roof.world_from_own(own_m[None], 0.0)[0]
    camera = scene.flight.centre_m
    share = (height_m - roof.height_m) / (camera[2] - roof.height_m)
    x, y = plan + share * (camera[:2] - plan)
    return float(x), float(y)


def hidden_line(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """A cloth hides line L1 altogether for a second in the event."""
    measured = scene.measured[0]
    lines, roof = measured.lines, measured.plate
    start = _middle_s(scene, brief)
    height = brief.roof_m + 0.3
    size = (1.25 * (lines.along_m[1] - lines.along_m[0]), 0.75 + 2 * brief.peak_m * 0.15)
    cloth = painting.paint_box(rng, size, 120.0, painting.RED, **Fineness.at(brief, height).arguments)
    at = _above(scene, roof, np.array([0.0, lines.l1_y_m]), height)
    plate = Plate(
        "passing cloth",
        height,
        cloth,
        at,
        roof.heading_rad,
        roof.motion,
        lambda t: _within(np.asarray(t), start, start + 1),
    )
    return replace(_with_plate(scene, plate), hidden_s=(*scene.hidden_s, (start, start + 1)))


def _within(time_s: Floats, start_s: float, end_s: float) -> Floats:
    return np.where((time_s >= start_s) & (time_s <= end_s), 1.0, 0.0)


def dust(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """Clouds of dust rise during the event and drift over ground and roof."""
    when = _middle_s(scene, brief)
    for number in range(9):
        radius = rng.uniform(1.5, 3.5)
        height = rng.uniform(4.0, 0.9 * brief.roof_m) if number % 2 else brief.roof_m + 2.0
        puff = painting.paint_blob(rng, radius, 185.0, texel_m=0.05, blur_m=0.2 * radius)
        start = when + rng.uniform(-2, 2)
        x, y = rng.uniform(-6, 6, 2) * (1.8 if number % 2 else 1.0)
        motion = passing((rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 1.5)), start)
        opacity = _puff(start, rng.uniform(0.25, 0.6))
        scene = _with_plate(
            scene, Plate(f"passing dust {number}", height, puff, (x, y), motion=motion, opacity=opacity)
        )
    return scene


def _puff(start_s: float, densest: float) -> Callable[[Floats], Floats]:
    """Return an opacity that rises and thins out again within a few seconds."""
    return lambda t: densest * np.exp(-0.5 * ((np.asarray(t) - start_s - 1.0) / 1.2) ** 2)


def cloud_shadow(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """The soft edge of a cloud's shadow passes over everything, and another one leaves."""
    way = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(way), np.sin(way)])
    speed, when = 9.0, _middle_s(scene, brief)

    def brightness(time_s: float, plan_m: Floats) -> Floats:
        ahead = plan_m @ normal - speed * (time_s - when)
        ragged = ahead + 1.5 * np.sin(plan_m @ normal[::-1] / 4)
        return 1 - 0.4 / (1 + np.exp(ragged / 2.0)) + 0.3 / (1 + np.exp((ragged + 22) / 3.0))

    return replace(scene, light=replace(scene.light, cloud=brightness))


def flicker(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """The exposure flickers and jumps, as an automatic camera's does."""
    jumps = np.cumsum(rng.normal(0, 0.05, 400))
    jumps -= np.linspace(0, jumps[-1], 400)
    steady = scene.light.exposure

    def exposure(time_s: Floats) -> Floats:
        time = np.asarray(time_s)
        step = np.clip(jumps[(time * 2.3).astype(int) % 400], -0.12, 0.12)
        return np.asarray(steady(time) * (1 + 0.035 * np.sin(2 * np.pi * 9.7 * time)) * (1 + step))

    return replace(scene, light=replace(scene.light, exposure=exposure))


def gust(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """A gust turns the view by 300 pixels of 4K within a second in the event, and a lesser one before it."""
    turn = 300 / 3840 / brief.focal_share
    pushes = (
        Gust(_middle_s(scene, brief) - 0.6, 1.0, (turn, 0.35 * turn), (0.35, -0.2, 0.1)),
        Gust(0.35 * brief.pre_event_s, 0.9, (-0.25 * turn, 0.3 * turn), (-0.1, 0.15, 0.0)),
    )
    return replace(scene, flight=replace(scene.flight, gusts=pushes))


def gravel_roof(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """The roof carries gravel and not a single line: a points target."""
    old = scene.measured[0]
    fine = Fineness.at(brief, brief.roof_m, 4.0)
    roof = replace(old.plate, texture=painting.paint_gravel_roof(rng, brief.roof_size_m, **fine.arguments))
    plates = tuple(roof if plate is old.plate else plate for plate in scene.plates)
    return replace(scene, plates=plates, measured=(replace(old, plate=roof, kind="points"),))


def measured_table(scene: Scene, brief: Brief, rng: Rng) -> Scene:
    """The building stands on a wider table 1.2 m high with lines of its own: two heights, one difference."""
    assert scene.body is not None
    height, size = 1.2, (16.5, 14.0)
    lines = RoofLines(-5.0, -6.22, 6.6, (-4.0, 7.8), (-6.7, 5.6))
    fine = Fineness.at(brief, height, 4.0)
    texture: Texture = painting.paint_table(rng, size, lines, **fine.arguments)
    table = Plate("table", height, texture, scene.body.centre_m, scene.body.heading_rad, scene.body.base_motion)
    roof = scene.measured[0]
    flight = replace(scene.flight, centre_m=np.array([3.4, -3.2, brief.altitude_m]))
    return replace(
        scene,
        plates=(table, *scene.plates),
        body=replace(scene.body, base_m=height),
        measured=(roof, Measured(table, lines, name="table"), replace(roof, name="storey_drift", relative_to="table")),
        light=replace(scene.light, shadow_m_per_m=(-0.35, 0.4)),
        flight=flight,
    )
