"""What a scene is composed from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sample_data.scene import Recording, Scene, Sensor, Survey

Rng = np.random.Generator


@dataclass(frozen=True)
class Brief:
    """A scene in an engineer's words; the ordinary one, EQ7-like, is all defaults.

    Attributes:
        size_px: width and height of the upright video.
        focal_share: focal length as a part of the longer side of the image.
        altitude_m, roof_m: heights of camera and roof above the ground.
        off_nadir_deg: how far the camera looks away from straight down.
        pre_event_s, event_s, post_event_s: lengths of the clip's parts.
        starts_s: how far into the motion the clip starts: everything before is cut off.
        peak_m, residual_m, natural_hz, damping, ringing_s, rotation_rad: of the roof.
        drift_m, drift_band_hz: of the hovering camera.
        turn_deg: slow turning of the camera, and its gimbal's quick wobble.
        margin_m: ground painted beyond what the undisturbed view shows.
        texture: contrast of the ground, 1 for ordinary ground.
        noise: read noise (grey levels) and shot noise (variance per grey level).
        roof_size_m: along the roof and across it.
        extras: what else stands, passes or changes.
        look: another number is another site, flight and earthquake under the same seed.
    """

    size_px: tuple[int, int] = (3840, 2160)
    focal_share: float = 0.56
    altitude_m: float = 42.0
    roof_m: float = 18.3
    off_nadir_deg: float = 1.2
    pre_event_s: float = 9.0
    event_s: float = 8.0
    post_event_s: float = 5.0
    starts_s: float = 0.0
    peak_m: float = 0.42
    residual_m: tuple[float, float] = (0.0, 0.0)
    natural_hz: float = 1.1
    damping: float = 0.06
    ringing_s: float = 2.0
    rotation_rad: float = 2e-3
    drift_m: float = 0.2
    drift_band_hz: tuple[float, float] = (0.03, 0.45)
    turn_deg: tuple[float, float] = (0.35, 0.02)
    margin_m: float = 2.5
    texture: float = 1.0
    noise: tuple[float, float] = (1.2, 0.022)
    roof_size_m: tuple[float, float] = (10.6, 7.4)
    sensor: Sensor = field(default_factory=Sensor)
    recording: Recording = field(default_factory=Recording)
    survey: Survey = field(default_factory=Survey)
    extras: tuple[Callable[[Scene, Brief, Rng], Scene], ...] = ()
    look: int = 0

    @property
    def duration_s(self) -> float:
        """Length of the clip."""
        return self.pre_event_s + self.event_s + self.post_event_s - self.starts_s

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return self.focal_share * max(self.size_px)
