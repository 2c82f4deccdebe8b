"""Texture that moves with a target: patches of the reference frame, found wherever the target has moved."""

from __future__ import annotations

import numpy as np

from core.apparent import Apparent
from core.coordinates import Floats, apply_homography, homography_jacobian, invert_2x2
from core.lens import Lens
from core.patches import PatchTracker, Singles
from core.video import Luma

# Fewer patches about lines tell no more than chance: what a roof shows is then not looked for, and a frame that shows
# no more of it is measured by its lines alone.
LEAST_PATCHES = 12


class Texture:
    """Patches that move with a target.

    Args:
        luma: the reference frame, (height, width).
        points_raw: (N, 2) their centres in it, raw pixels.
        pivot: (2,) of the target's apparent rotation, rays of the reference frame; the patches' middle where None.

    Attributes:
        patches: the same, to be found.
        rays0: (N, 2) of their centres in the reference frame.
        pivot: (2,) as given, or their middle.
    """

    def __init__(self, luma: Luma, points_raw: Floats, lens: Lens, pivot: Floats | None = None) -> None:
        self._lens = lens
        self.patches = PatchTracker(luma, points_raw)
        self.rays0 = lens.rays_from_raw(points_raw)
        self._J0_inverse = invert_2x2(lens.jacobian_raw_rays(self.rays0))
        self.pivot = self.rays0.mean(axis=0) if pivot is None else pivot

    def __len__(self) -> int:
        return len(self.patches)

    def find(
        self,
        luma: Luma,
        H_ray_ray0: Floats,
        predicted: Apparent,
        *,
        least_score: float | None = None,
        is_view: bool = False,
    ) -> Floats:
        """Return where the patches are in a frame, (N, 2) raw pixels; nan where not found.

        Args:
            luma: the frame.
            H_ray_ray0: of its camera.
            predicted: the target's motion.
            least_score: correlation that a patch must reach; the usual one where None.
            is_view: as for `PatchTracker.track`.
        """
        matches = self.patches.track(luma, *self._expected(H_ray_ray0, predicted), is_view=is_view)
        known = matches.score >= (least_score or self.patches.least_score)
        return np.where(known[:, None], matches.raw, np.nan)

    def views(self, luma: Luma, H_ray_ray0: Floats, apparent: Apparent | None) -> Singles:
        """Return the patches as a frame shows them if the target moved so; see `PatchTracker.views`."""
        raw, ref_from_current = self._expected(H_ray_ray0, apparent or Apparent.none())
        if apparent is None:
            raw = np.full_like(raw, np.nan)
        return self.patches.views(luma, raw, ref_from_current)

    def _expected(self, H_ray_ray0: Floats, apparent: Apparent) -> tuple[Floats, Floats]:
        """Return where the patches should be, (N, 2) raw pixels, and how they are deformed, as `PatchTracker.track`."""
        moved = apparent.apply(self.rays0, self.pivot)
        rays = apply_homography(H_ray_ray0, moved)
        c, s = np.cos(apparent.rotation_rad), np.sin(apparent.rotation_rad)
        turn = np.array([[c, -s], [s, c]])
        J = self._lens.jacobian_raw_rays(rays) @ homography_jacobian(H_ray_ray0, moved) @ turn @ self._J0_inverse
        return self._lens.raw_from_rays(rays), invert_2x2(J)
