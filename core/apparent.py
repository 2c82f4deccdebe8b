"""How a target seems to have moved: what predictions are made of.

Positions are *rays of the reference frame*: a frame's ground homography H_ray_ray0 takes out the camera, and what
remains is the target's own motion, and parallax.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.coordinates import Floats


@dataclass(frozen=True)
class Apparent:
    """Apparent rigid motion of a target in rays of the reference frame.

    Attributes:
        shift: (2,).
        rotation_rad: about the target's middle.
        step: of a prediction, how far the target has gone from the frame before the last to the last; else None.
    """

    shift: Floats
    rotation_rad: float
    step: float | None = None

    @staticmethod
    def none() -> Apparent:
        """Return the state of rest."""
        return Apparent(np.zeros(2), 0.0)

    def towards(self, earlier: Apparent, factor: float) -> Apparent:
        """Return the motion extrapolated from an earlier one by `factor` of the step between the two."""
        return Apparent(
            self.shift + factor * (self.shift - earlier.shift),
            self.rotation_rad + factor * (self.rotation_rad - earlier.rotation_rad),
            float(np.linalg.norm(self.shift - earlier.shift)),
        )

    def apply(self, points: Floats, centre: Floats) -> Floats:
        """Return where points (..., 2) of the reference frame have moved."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        return np.asarray((points - centre) @ np.array([[c, s], [-s, c]]) + centre + self.shift)
