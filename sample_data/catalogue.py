"""The named scenes, each a few words about what is different from the ordinary one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sample_data import happenings, painting
from sample_data.brief import Brief
from sample_data.flight import Flight, Wandering
from sample_data.happenings import Fineness
from sample_data.optics import TrueLens
from sample_data.scene import Body, Light, Measured, Plate, Recording, Relief, RoofLines, Scene, Sensor, Survey
from sample_data.shaking import Earthquake, Shaking

Floats = NDArray[np.float64]
Rng = np.random.Generator


def build(
    name: str,
    *,
    seed: int = 1,
    size_px: tuple[int, ...] | None = None,
    duration_s: float | None = None,
    preset: str | None = None,
) -> Scene:
    """Return a scene of the catalogue, perhaps in another size or length, or by another preset of the encoder.

    Raises:
        KeyError: no scene has this name.
    """
    brief = SCENES[name]
    if size_px is not None:
        brief = replace(brief, size_px=(size_px[0], size_px[1]))
    if duration_s is not None:
        share = duration_s / brief.duration_s
        brief = replace(
            brief,
            pre_event_s=brief.pre_event_s * share,
            event_s=brief.event_s * share,
            post_event_s=brief.post_event_s * share,
            starts_s=brief.starts_s * share,
        )
    if preset is not None:
        options = {**brief.recording.options, "preset": preset}
        brief = replace(brief, recording=replace(brief.recording, options=options))
    return compose(name, brief, seed)


def compose(name: str, brief: Brief, seed: int) -> Scene:
    """Return the scene a brief describes; everything random follows from the seed."""
    rng = np.random.default_rng([seed, 1 + brief.look])
    shaking = _shaking(brief, rng)
    flight = _flight(brief, rng)
    roof, lines = _roof(brief, rng, shaking)
    scene = Scene(
        name=name,
        seed=seed,
        duration_s=brief.duration_s,
        lens=_lens(brief, rng),
        flight=flight,
        ground=painting.paint_ground(
            rng, _ground_extent(brief, flight), contrast=brief.texture, **Fineness.at(brief, 0.0).arguments
        ),
        relief=Relief.random(rng, 0.04, 1.1 * brief.altitude_m),
        plates=(roof, *_standing_objects(brief, rng)),
        body=_body(brief, rng, roof, shaking),
        measured=(Measured(roof, lines),),
        light=_light(brief, rng),
        sensor=replace(brief.sensor, read_noise=brief.noise[0], shot_noise=brief.noise[1]),
        recording=brief.recording,
        survey=replace(brief.survey, intervals_s=_intervals(brief)),
    )
    for extra in brief.extras:
        scene = extra(scene, brief, rng)
    return scene


def _shaking(brief: Brief, rng: Rng) -> Shaking:
    quake = Earthquake(
        start_s=brief.pre_event_s,
        duration_s=brief.event_s,
        peak_m=brief.peak_m,
        residual_m=brief.residual_m,
        rotation_rad=brief.rotation_rad,
        table_peak_m=0.3 * brief.peak_m,
        natural_hz=brief.natural_hz,
        damping=brief.damping,
        ringing_s=brief.ringing_s,
    )
    whole = Shaking.of(quake, brief.duration_s + brief.starts_s, rng)
    cut = brief.starts_s
    return (
        Shaking(lambda t: whole.table(np.asarray(t) + cut), lambda t: whole.roof(np.asarray(t) + cut)) if cut else whole
    )


def _flight(brief: Brief, rng: Rng) -> Flight:
    way, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.03, 0.055) * brief.altitude_m / brief.focal_share
    lean = brief.altitude_m * np.tan(np.radians(brief.off_nadir_deg if brief.off_nadir_deg > 5 else 0.0))
    heading = rng.uniform(-0.12, 0.12)
    # An oblique camera stands back, so that the building stays in view.
    back = 0.75 * lean * np.array([np.sin(heading), np.cos(heading)])
    centre = np.array([away * np.cos(way) - back[0], away * np.sin(way) - back[1], brief.altitude_m])
    slow, quick = np.radians(brief.turn_deg)
    length = brief.duration_s
    return Flight(
        centre_m=centre,
        off_nadir_rad=float(np.radians(brief.off_nadir_deg)),
        heading_rad=heading,
        drift=Wandering.random(
            rng, reach=brief.drift_m * np.array([1.0, 0.85, 0.5]), band_hz=brief.drift_band_hz, duration_s=length
        ),
        turning=(
            Wandering.random(rng, reach=slow * np.array([1.0, 0.9, 0.8]), band_hz=(0.04, 0.5), duration_s=length),
            Wandering.random(rng, reach=quick * np.array([1.0, 1.0, 0.4]), band_hz=(0.7, 4.0), duration_s=length),
        ),
    )


def _lens(brief: Brief, rng: Rng) -> TrueLens:
    width, height = brief.size_px
    focal = brief.focal_px * (1 + rng.normal(0, 0.004)) * np.array([1.0, 1 + rng.normal(0, 3e-4)])
    centre = np.array([(width - 1) / 2, (height - 1) / 2]) + rng.normal(0, 0.004 * width, 2)
    distortion = np.array([-0.125, 0.105, 4e-4, -3e-4, -0.018]) * rng.uniform(0.85, 1.15, 5)
    return TrueLens((width, height), focal, centre, distortion)


def _ground_extent(brief: Brief, flight: Flight) -> tuple[float, float, float, float]:
    """Return west, south, east, north of what any frame may see, roughly; beyond, the ground repeats mirrored."""
    half = 0.5 * np.array(brief.size_px) / brief.focal_px * 1.1
    tilt = flight.off_nadir_rad if brief.off_nadir_deg > 5 else 0.0
    x, y = flight.centre_m[:2]
    near, far = np.tan(tilt - np.arctan(half[1])), np.tan(tilt + np.arctan(half[1]))
    wide = half[0] / np.cos(tilt) / (1 - np.tan(tilt) * half[1])
    margin = brief.margin_m
    east = brief.altitude_m * wide + margin
    return (
        float(x - east),
        float(y + brief.altitude_m * near - margin),
        float(x + east),
        float(y + brief.altitude_m * far + margin),
    )


def _roof(brief: Brief, rng: Rng, shaking: Shaking) -> tuple[Plate, RoofLines]:
    wide, deep = brief.roof_size_m
    x, y = rng.uniform(-0.5, 0.5), rng.uniform(-0.25, 0.25)
    lines = RoofLines(y + 0.61, y - 0.61, x, (-0.36 * wide, 0.36 * wide), (-0.4 * deep, 0.4 * deep))
    texture = painting.paint_roof(rng, brief.roof_size_m, lines, **Fineness.at(brief, brief.roof_m, 5.0).arguments)
    centre = tuple(rng.uniform(-0.6, 0.6, 2))
    return Plate("roof", brief.roof_m, texture, centre, rng.uniform(-0.02, 0.02), shaking.roof), lines


def _body(brief: Brief, rng: Rng, roof: Plate, shaking: Shaking) -> Body:
    wide, deep = brief.roof_size_m
    size = (wide - 0.1, deep - 0.1)
    walls = tuple(painting.paint_wall(rng, size[side % 2], brief.roof_m) for side in range(4))
    return Body(size, 0.0, brief.roof_m - 0.02, roof.centre_m, roof.heading_rad, shaking.table, shaking.roof, walls)


def _standing_objects(brief: Brief, rng: Rng) -> list[Plate]:
    """Return parked cars, containers and crates around the building: they stand still but are no flat ground."""
    pixel = brief.altitude_m / brief.focal_px
    fine = Fineness.at(brief, 1.5).arguments
    reach = 0.42 * np.array(brief.size_px) * pixel
    plates = []
    for number in range(9):
        while True:
            at = rng.uniform(-reach, reach)
            if np.abs(at / [13.0, 11.0]).max() > 1:
                break
        kind = number % 3
        if kind == 0:
            texture, height = painting.paint_car(rng, **fine), 1.45
        elif kind == 1:
            paint = (painting.BLUE, painting.RED, painting.CONCRETE)[rng.integers(0, 3)]
            texture = painting.paint_box(rng, (6.06, 2.44), rng.uniform(60, 180), paint, **fine)
            height = 2.6
        else:
            texture = painting.paint_box(rng, (1.2, 1.0), rng.uniform(60, 220), painting.SOIL, **fine)
            height = 0.8
        plates.append(Plate(f"parked {number}", height, texture, (at[0], at[1]), rng.uniform(0, np.pi)))
    return plates


def _light(brief: Brief, rng: Rng) -> Light:
    phase = rng.uniform(0, 2 * np.pi)
    way = rng.uniform(0, 2 * np.pi)
    return Light(
        shadow_m_per_m=(0.55 * np.cos(way), 0.55 * np.sin(way)),
        exposure=lambda t: 1 + 0.04 * np.sin(2 * np.pi * 0.04 * np.asarray(t) + phase),
    )


def _intervals(brief: Brief) -> dict[str, tuple[float, float] | None]:
    start, end = brief.pre_event_s - brief.starts_s, brief.duration_s
    settle = min(brief.ringing_s, 0.4 * brief.post_event_s)
    tail = (round(end - brief.post_event_s + settle, 2), round(end - 0.1, 2))
    if start <= 0.5:
        return {"pre_event": tail, "event": (0.0, tail[0]), "residual": None}
    return {"pre_event": (0.0, round(start - 0.1, 2)), "event": (round(start, 2), tail[0]), "residual": tail}


_SMALL = Brief(
    size_px=(960, 540),
    focal_share=0.99,
    pre_event_s=3.0,
    event_s=3.0,
    post_event_s=2.0,
    ringing_s=0.8,
    recording=Recording(bit_rate=8_000_000),
    survey=Survey(cloud_points=120_000, boards=0),
)
_EQ5 = Brief(look=1, peak_m=0.10, rotation_rad=8e-4)
_EQ7 = Brief()
_EQ9 = Brief(
    look=2, altitude_m=62.0, peak_m=0.795, residual_m=(0.22, 0.015), natural_hz=0.8, rotation_rad=3e-3, post_event_s=6.0
)
_FULL_HD = Brief(look=3, size_px=(1920, 1080), recording=Recording(bit_rate=16_000_000))


def _long_and_slow(brief: Brief) -> Brief:
    """Return the scene with drift as slow as the paper's filter needs it, and long enough to see that."""
    return replace(brief, pre_event_s=14.0, event_s=14.0, post_event_s=8.0, drift_band_hz=(0.02, 0.12))


SCENES: dict[str, Brief] = {
    "eq5": _EQ5,
    "eq7": _EQ7,
    "eq9": _EQ9,
    "eq5_slow_drift": _long_and_slow(_EQ5),
    "eq7_slow_drift": _long_and_slow(_EQ7),
    "windy": replace(_EQ7, look=5, drift_m=0.6, turn_deg=(0.8, 0.04), margin_m=5.0),
    "tall_flexible": Brief(
        look=4,
        altitude_m=55.0,
        roof_m=30.0,
        natural_hz=0.18,
        damping=0.04,
        ringing_s=float("inf"),
        event_s=9.0,
        post_event_s=6.0,
    ),
    "poor_texture": Brief(look=6, texture=0.25, noise=(5.0, 0.0), recording=Recording(bit_rate=16_000_000)),
    "fullhd": _FULL_HD,
    "oblique": Brief(look=7, off_nadir_deg=25.0, sensor=Sensor(samples=(1, 3))),
    "crossings": Brief(look=8, extras=(happenings.crossing_person_and_car, happenings.bird_over_line)),
    "dust": Brief(look=9, extras=(happenings.dust,)),
    "cloud_shadow": Brief(look=10, extras=(happenings.cloud_shadow,)),
    # Late light: a long exposure smears the moving roof over several pixels, and little light means noise.
    "dusk": Brief(look=25, sensor=Sensor(exposure_s=1 / 60), noise=(3.0, 0.06), peak_m=0.6),
    # Hardly any light at all: a reference frame that is half noise, which patches must not be compared with as it is.
    "night": replace(_FULL_HD, look=26, texture=0.5, noise=(8.0, 0.0), recording=Recording(bit_rate=20_000_000)),
    "flicker": Brief(look=11, extras=(happenings.flicker,)),
    "hidden_line": Brief(look=12, extras=(happenings.hidden_line,)),
    "gust": Brief(look=13, extras=(happenings.gust,), margin_m=9.0),
    "mid_shaking": Brief(look=14, pre_event_s=2.0, starts_s=4.5, post_event_s=9.0, ringing_s=3.0),
    "fps60": replace(_FULL_HD, look=20, recording=Recording(rate_hz=60.0, bit_rate=25_000_000)),
    "fps120": replace(
        _FULL_HD,
        look=21,
        pre_event_s=6.0,
        event_s=5.0,
        post_event_s=3.0,
        sensor=Sensor(exposure_s=1 / 500),
        recording=Recording(rate_hz=120.0, bit_rate=40_000_000),
    ),
    "variable_rate": replace(_FULL_HD, look=22, recording=Recording(bit_rate=16_000_000, uneven_time=0.2)),
    "h265": replace(_FULL_HD, look=23, recording=Recording(bit_rate=10_000_000, codec="libx265")),
    "portrait": Brief(look=15, size_px=(2160, 3840), roof_size_m=(9.6, 7.4), recording=Recording(turned=True)),
    "points_roof": Brief(look=16, extras=(happenings.gravel_roof,)),
    "two_targets": Brief(look=17, roof_size_m=(7.2, 5.4), extras=(happenings.measured_table,)),
    "rolling_shutter": Brief(look=18, sensor=Sensor(readout_s=0.02), turn_deg=(0.35, 0.05)),
    "national_grid": replace(_FULL_HD, look=24, survey=Survey(cloud_origin_m=(487231.0, 3639450.0, 127.3))),
    "small": _SMALL,
    "sample": replace(
        _SMALL,
        size_px=(1280, 720),
        focal_share=0.75,
        peak_m=0.36,
        residual_m=(0.085, -0.02),
        pre_event_s=7.0,
        event_s=8.0,
        post_event_s=5.0,
        ringing_s=2.0,
        recording=Recording(bit_rate=2_950_000, options={"preset": "slow", "g": "60"}),
        survey=Survey(cloud_points=700_000, boards=12),
    ),
}
"""Name and brief of each scene."""
