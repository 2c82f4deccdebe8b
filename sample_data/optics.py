"""The true lens of a rendered scene.

Written apart from `core.lens` on purpose: an error in the engine's lens model must not cancel against the same one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_NEWTON_STEPS = 12


@dataclass(frozen=True, eq=False)
class TrueLens:
    """Pinhole with the distortion k1 k2 p1 p2 k3; (0, 0) is the centre of the top-left pixel.

    Attributes:
        image_size_px: (width, height).
        focal_px: (2,) fx, fy.
        centre_px: (2,) cx, cy.
        distortion: (5,) k1 k2 p1 p2 k3.
    """

    image_size_px: tuple[int, int]
    focal_px: Floats
    centre_px: Floats
    distortion: Floats

    @property
    def camera_matrix(self) -> Floats:
        """(3, 3) as OpenCV writes it."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def raw_from_rays(self, rays: ArrayLike) -> Floats:
        """Return raw pixels (..., 2) of rays (..., 2) = (x/z, y/z)."""
        return self._distorted(np.asarray(rays, dtype=np.float64)) * self.focal_px + self.centre_px

    def rays_from_raw(self, raw: ArrayLike) -> Floats:
        """Return rays (..., 2) seen at raw pixels (..., 2), by Newton's method with a numerical Jacobian."""
        wanted = (np.asarray(raw, dtype=np.float64) - self.centre_px) / self.focal_px
        rays = wanted.copy()
        for _ in range(_NEWTON_STEPS):
            step = self._newton_step(rays, wanted)
            rays += step
            if np.abs(step).max() < 1e-12:
                break
        return rays

    def _distorted(self, rays: Floats) -> Floats:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            (
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ),
            axis=-1,
        )

    def _newton_step(self, rays: Floats, wanted: Floats) -> Floats:
        h = 1e-6
        here = self._distorted(rays)
        along_x = (self._distorted(rays + [h, 0.0]) - here) / h
        along_y = (self._distorted(rays + [0.0, h]) - here) / h
        miss = wanted - here
        determinant = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
        return np.stack(
            (
                (along_y[..., 1] * miss[..., 0] - along_y[..., 0] * miss[..., 1]) / determinant,
                (along_x[..., 0] * miss[..., 1] - along_x[..., 1] * miss[..., 0]) / determinant,
            ),
            axis=-1,
        )
