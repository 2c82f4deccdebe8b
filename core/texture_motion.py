"""What the texture about a target's lines adds to their motion.

One strip alone tells the motion along the other two, and compression moves a strip as it likes; patches about the
strips are spread over many of its blocks. They move with the strips but lie at heights of their own, a parapet below
them or on a duct: how far from the strips' plane is read off how much more than these each patch seems to move. Nobody
has said that all of them lie on the roof, so only those take part whose height and motion say so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.bodies import RestBody
from core.camera import Pose, PoseFit, intersect_height
from core.coordinates import Bools, Floats, finite_rows
from core.lens import Lens
from core.measurements import Recording
from core.motion import RigidFit, combined_fit
from core.robust import finite_median, robust_sigma
from core.texture import LEAST_PATCHES

# How far from the strips' plane patches lie where nothing tells, one standard deviation, metres.
RELIEF_SIGMA_M = 0.5
RELIEF_ROUNDS = 2
# A patch takes part where it is known to be no further from the strips' plane than this, metres. Others may lie on a
# lower storey or on the ground, whose motion differs too little from the roof's in weak shaking to tell them apart.
MOST_RELIEF_M = 1.5
# One standard deviation of a height that counts as known, metres.
KNOWN_RELIEF_M = 0.2
# What is left of a patch in a frame counts as an outlier beyond so many standard deviations.
OUTLYING = 5.0
# A patch that departs from the strips' motion by so many times what a place of theirs does shows something else, and
# none is credibly so many times better than they.
MOST_SCATTER = 2.5
LEAST_SCATTER = 0.25
# A patch must be seen in this part of the frames in which the lines are.
LEAST_SEEN = 0.5
# Neighbouring places of a strip share blocks of the compression and err alike, so that a patch that scatters as much
# tells as much as three of them (measured on H.264 clips; from two to five the error changes by a thirtieth).
PLACES_PER_PATCH = 3.0


def with_texture(
    lines: RigidFit,
    recording: Recording,
    name: str,
    *,
    body: RestBody,
    known: Bools,
    lens: Lens,
    pose0: Pose,
    poses: PoseFit,
    z_m: float,
) -> tuple[RigidFit, Bools]:
    """Return the motion of a target's lines and the texture about them together, and which patches (N,) took part.

    Args:
        lines: motion of the lines alone.
        name: of the target.
        body: its lines at rest.
        known: (F,) frames in which the lines fix their motion and the camera is known.
        lens, pose0, poses: of the recording, of the reference frame and of all frames.
        z_m: of the lines' plane.
    """
    raw = recording.texture_of(name)
    if raw.shape[1] < LEAST_PATCHES or not known.any():
        return lines, np.zeros(raw.shape[1], dtype=np.bool_)
    rays = lens.rays_from_raw(np.where(known[:, None, None], raw, np.nan))
    patches = _Patches(rays, lens.rays_from_raw(recording.reference.texture_raw[name]), pose0, poses)
    z, sigma_m = np.full(raw.shape[1], z_m), np.zeros(raw.shape[1])
    for _ in range(RELIEF_ROUNDS):
        raised, sigma_m = patches.raised_by(z, lines, body.centre)
        z = z + raised
    near = (np.abs(z - z_m) < MOST_RELIEF_M) & (sigma_m < KNOWN_RELIEF_M)
    left = patches.left_over(z, lines, body.centre)
    lasting = _lasting(left)
    scatter, of_places = _scatter(left - lasting), float(np.median(finite_median(lines.sigma[known])))
    seen = finite_rows(left).sum(axis=0) >= LEAST_SEEN * known.sum()
    belonging = near & seen & (scatter < MOST_SCATTER * of_places)
    if belonging.sum() < LEAST_PATCHES:
        return lines, np.zeros_like(belonging)
    texture = RestBody(None, patches.at_rest(z)[belonging], None, body.centre, body.places)
    motion = texture.fit((patches.places(z) - lasting)[:, belonging], np.zeros(len(known), dtype=np.bool_))
    enough = (motion.weight > 0.1).sum(axis=1) >= LEAST_PATCHES
    typical = max(float(np.median(scatter[belonging])), LEAST_SCATTER * of_places)
    worth = PLACES_PER_PATCH * (of_places / typical) ** 2
    return combined_fit(lines, motion, np.where(enough, worth, 0.0)), belonging


@dataclass(frozen=True)
class _Patches:
    """N patches in F frames.

    Attributes:
        rays: (F, N, 2), nan where not seen.
        rays0: (N, 2) in the reference frame.
        pose0, poses: of the reference frame and of all frames.
    """

    rays: Floats
    rays0: Floats
    pose0: Pose
    poses: PoseFit

    def places(self, z: Floats) -> Floats:
        """Return where the patches are (F, N, 2) if they lie at heights z (N,)."""
        return intersect_height(self.poses.R, self.poses.centre_m, self.rays, z)

    def at_rest(self, z: Floats) -> Floats:
        """Return where they are (N, 2) in the reference frame."""
        return intersect_height(self.pose0.R, self.pose0.centre_m, self.rays0, z)

    def left_over(self, z: Floats, motion: RigidFit, centre: Floats) -> Floats:
        """Return how far beyond a motion about a centre the patches are (F, N, 2)."""
        return self.places(z) - motion.carried(self.at_rest(z), centre)

    def raised_by(self, z: Floats, motion: RigidFit, centre: Floats) -> tuple[Floats, Floats]:
        """Return how much higher (N,) than z patches must lie for what they leave over of a motion to be parallax.

        And one standard deviation of that, metres.
        """
        left, rest = self.left_over(z, motion, centre), self.at_rest(z)
        # A patch that lies a metre higher moves more, against the camera, by this part of its motion.
        below = (self.pose0.centre_m[2] - z)[:, None]
        gain = (motion.carried(rest, centre) - rest - (self.poses.centre_m - self.pose0.centre_m)[:, None, :2]) / below
        left = left - _lasting(left)
        sigma = _scatter(left)
        seen = (np.abs(left) < OUTLYING * sigma[:, None]).all(axis=-1, keepdims=True)
        count = np.maximum(seen.sum(axis=0), 1)
        gain = np.where(seen, gain - np.where(seen, gain, 0.0).sum(axis=0) / count, 0.0)
        information = (gain**2).sum(axis=(0, 2)) + (sigma / RELIEF_SIGMA_M) ** 2
        explained = (gain * np.where(seen, left, 0.0)).sum(axis=(0, 2))
        return explained / np.maximum(information, 1e-300), sigma / np.sqrt(np.maximum(information, 1e-300))


def _lasting(left: Floats) -> Floats:
    """Return what patches leave over (F, N, 2) in all frames alike, (N, 2): the noise of the reference frame."""
    return finite_median(np.moveaxis(left, 0, -1))


def _scatter(left: Floats) -> Floats:
    """Return the standard deviation (N,) along an axis of what patches leave over (F, N, 2) in all frames."""
    return robust_sigma(np.moveaxis(left, 0, -1).reshape(left.shape[1], -1))
