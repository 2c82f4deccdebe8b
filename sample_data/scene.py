"""What stands and moves in a scene, and with which camera it is filmed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sample_data.flight import Flight
from sample_data.optics import TrueLens
from sample_data.shaking import Motion, at_rest
from sample_data.textures import Texture, look_up

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def always(time_s: Floats) -> Floats:
    """Return (times,) ones: fully there at all times."""
    return np.ones(np.shape(time_s))


@dataclass(frozen=True, eq=False)
class Relief:
    """Height of the ground, a smooth field sampled on a grid.

    Attributes:
        height_m: (rows, columns) float32, south to north, west to east.
        west_m, south_m: place of the first sample.
        step_m: between samples.
    """

    height_m: NDArray[np.float32]
    west_m: float
    south_m: float
    step_m: float

    @classmethod
    def random(cls, rng: np.random.Generator, reach_m: float, half_width_m: float) -> Relief:
        """Return swells and hollows of up to ± `reach_m`, wavelengths of 6 to 40 m, and no tilt over the whole."""
        step = 0.25
        axis = np.arange(-half_width_m, half_width_m, step)
        x, y = np.meshgrid(axis, axis)
        height = np.zeros_like(x)
        for length_m in np.geomspace(6, 40, 14):
            way = rng.uniform(0, 2 * np.pi)
            wave = 2 * np.pi * (x * np.cos(way) + y * np.sin(way)) / length_m + rng.uniform(0, 2 * np.pi)
            height += np.sin(wave) * length_m**0.5
        height *= reach_m / np.abs(height).max()
        return cls(height.astype(np.float32), float(axis[0]), float(axis[0]), step)

    def at(self, plan_m: Floats) -> Floats:
        """Return the height (...,) over places (..., 2), metres."""
        samples = ((plan_m - [self.west_m, self.south_m]) / self.step_m).astype(np.float32)
        return look_up(self.height_m, samples.reshape(-1, 2)).reshape(plan_m.shape[:-1])


@dataclass(frozen=True, eq=False)
class Plate:
    """A flat horizontal thing above the ground: a roof, the shake table, a car's top, a bird.

    Attributes:
        name: of it.
        height_m: above the ground's mean plane.
        texture: in the plate's own metres, around its own (0, 0).
        centre_m: (2,) where its (0, 0) lies at rest.
        heading_rad: how its x axis is turned from east at rest, counter-clockwise.
        motion: displacement of its centre and rotation about it.
        opacity: how much of it is there at a time, 0 to 1.
    """

    name: str
    height_m: float
    texture: Texture
    centre_m: tuple[float, float]
    heading_rad: float = 0.0
    motion: Motion = at_rest
    opacity: Callable[[Floats], Floats] = always

    @property
    def corners_m(self) -> Floats:
        """(4, 2) own metres of the texture's outer corners, counter-clockwise."""
        t = self.texture
        east, south = t.west_m + t.luma.shape[1] * t.texel_m, t.north_m - t.luma.shape[0] * t.texel_m
        return np.array([[t.west_m, south], [east, south], [east, t.north_m], [t.west_m, t.north_m]])

    def world_from_own(self, own_m: Floats, time_s: float) -> Floats:
        """Return where points (n, 2) of the plate are at a time, world metres."""
        return place(own_m, self.centre_m, self.heading_rad, self.motion(np.array([time_s]))[0])


def place(own_m: Floats, centre_m: tuple[float, float], heading_rad: float, moved: Floats) -> Floats:
    """Return world metres (..., 2) of own points (..., 2) after a displacement (dx, dy, turn)."""
    c, s = np.cos(heading_rad + moved[2]), np.sin(heading_rad + moved[2])
    return own_m @ np.array([[c, s], [-s, c]]) + centre_m + moved[:2]


@dataclass(frozen=True, eq=False)
class Body:
    """The building between two heights: four walls that hide the ground behind them and throw a shadow.

    Attributes:
        size_m: east-west and north-south.
        base_m, top_m: heights of foot and eaves.
        centre_m, heading_rad: as of the roof.
        base_motion, top_motion: of table and roof.
        walls: four textures (south, east, north, west), x along the wall, y up from the foot.
    """

    size_m: tuple[float, float]
    base_m: float
    top_m: float
    centre_m: tuple[float, float]
    heading_rad: float
    base_motion: Motion
    top_motion: Motion
    walls: tuple[Texture, ...]

    def corners(self, time_s: float, *, top: bool) -> Floats:
        """Return (4, 3) world corners at a time: south-west, south-east, north-east, north-west."""
        half = np.array(self.size_m) / 2
        own = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        moved = (self.top_motion if top else self.base_motion)(np.array([time_s]))[0]
        plan = place(own, self.centre_m, self.heading_rad, moved)
        return np.column_stack((plan, np.full(4, self.top_m if top else self.base_m)))


@dataclass(frozen=True)
class RoofLines:
    """Where the measured lines are painted, in the roof's own metres.

    Attributes:
        l1_y_m, l2_y_m: the two lines along x.
        t1_x_m: the line along y.
        along_m: from and to, of L1 and L2, x.
        across_m: from and to, of T1, y.
    """

    l1_y_m: float
    l2_y_m: float
    t1_x_m: float
    along_m: tuple[float, float]
    across_m: tuple[float, float]

    @property
    def points_m(self) -> Floats:
        """(2, 2) P1 and P2."""
        return np.array([[self.t1_x_m, self.l1_y_m], [self.t1_x_m, self.l2_y_m]])


@dataclass(frozen=True, eq=False)
class Measured:
    """A plate that is measured, and what a person would say about it."""

    plate: Plate
    lines: RoofLines
    kind: str = "lines"
    name: str = "roof"
    relative_to: str | None = None


@dataclass(frozen=True)
class Light:
    """Sun and sky.

    Attributes:
        shadow_m_per_m: (2,) displacement of a shadow east and north per metre of height.
        shadow_share: brightness left in the shadow.
        exposure: brightness over time, relative.
        cloud: brightness over (times, plan metres (..., 2)), relative; None without clouds.
    """

    shadow_m_per_m: tuple[float, float] = (0.35, 0.45)
    shadow_share: float = 0.42
    exposure: Callable[[Floats], Floats] = always
    cloud: Callable[[float, Floats], Floats] | None = None


@dataclass(frozen=True)
class Sensor:
    """How the image is exposed and digitised.

    Attributes:
        exposure_s: shutter time.
        readout_s: time between the first and the last row.
        read_noise: grey levels, one standard deviation in the dark.
        shot_noise: variance in grey levels per grey level.
        samples: sub-pixel samples across and down.
        vignetting: share of the light missing in the corners.
    """

    exposure_s: float = 1 / 240
    readout_s: float = 0.0
    read_noise: float = 1.2
    shot_noise: float = 0.022
    samples: tuple[int, int] = (1, 1)
    vignetting: float = 0.12


@dataclass(frozen=True)
class Recording:
    """How the video is written.

    Attributes:
        rate_hz: nominal frames per second.
        bit_rate: bits per second.
        codec: encoder's name.
        options: for the encoder.
        uneven_time: one standard deviation of the time between frames, relative; 0 for a constant rate.
        turned: stored on its side, with a rotation flag that sets it upright.
    """

    rate_hz: float = 30.0
    bit_rate: int = 45_000_000
    codec: str = "libx264"
    options: dict[str, str] = field(default_factory=dict)
    uneven_time: float = 0.0
    turned: bool = False


@dataclass(frozen=True)
class Survey:
    """What the surveyors leave behind beside the video, and how well.

    Attributes:
        cloud_origin_m: (3,) added to all coordinates that leave the renderer (a national grid, say).
        cloud_points: of the LiDAR.
        click_px, click_m: one standard deviation of a click in the frame and in the orthoimage.
        lens_error: focal length (relative), principal point (px), k1: one standard deviation.
        gps_noise_m, gps_clock_s: of the antenna on the roof.
        intervals_s: named parts of the clip.
        boards: number of checkerboard images.
    """

    cloud_origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cloud_points: int = 400_000
    click_px: float = 0.7
    click_m: float = 0.012
    lens_error: tuple[float, float, float] = (6e-4, 1.5, 1.5e-3)
    height_error_m: float = 0.02
    gps_noise_m: float = 0.002
    gps_clock_s: float = 0.37
    intervals_s: dict[str, tuple[float, float] | None] = field(default_factory=dict)
    boards: int = 12


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that decides a rendered project; with the seed it is the same on every machine.

    `hidden_s` holds the times in which a measured line cannot be seen, so that nobody can measure it.
    """

    name: str
    seed: int
    duration_s: float
    lens: TrueLens
    flight: Flight
    ground: Texture
    relief: Relief
    plates: tuple[Plate, ...]
    body: Body | None
    measured: tuple[Measured, ...]
    light: Light
    sensor: Sensor
    recording: Recording
    survey: Survey
    hidden_s: tuple[tuple[float, float], ...] = ()

    def frame_times(self) -> Floats:
        """Return the (frames,) middle of each exposure, which is also its timestamp; the first is 0."""
        recording = self.recording
        count = round(self.duration_s * recording.rate_hz)
        steps = np.full(count - 1, 1 / recording.rate_hz)
        if recording.uneven_time:
            rng = np.random.default_rng([self.seed, 7])
            steps *= np.clip(1 + recording.uneven_time * rng.standard_normal(count - 1), 0.3, 3.0)
        ticks = np.round(np.concatenate(([0.0], np.cumsum(steps))) * TIME_BASE_HZ)
        return ticks / TIME_BASE_HZ


TIME_BASE_HZ = 90_000
"""Resolution of the container's timestamps."""
