"""What one frame can tell at best: the Cramér-Rao bound of a roof's displacement for the sensor's own noise.

Every pixel of a strip and of a ground patch says something about where that lies: its gradient squared by the variance
of its noise. Put together for the unknowns of one frame, the roof's shift and rotation and the camera's rotation, this
is Fisher's information, and the root of its inverse is the least standard deviation that any unbiased estimate can
reach from this frame. The camera's position counts as known, because a smooth flight can be learnt from all frames
together; so does the calibration. Encoding can only lose information, never add any.

Source: Kay, Fundamentals of Statistical Signal Processing I (1993), section 3.8; Robinson & Milanfar (2004) for images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from core.bodies import rest_body
from core.camera import exponential, intersect_height, jacobians, project
from core.coordinates import Floats, rotation_2d
from core.measurements import Recording
from core.patches import HALF_PX
from core.project import Target
from core.run import LoadedInputs
from core.solution import Solution
from core.video import Luma, read_frame

# Pixels beyond the edges of a strip that still see them through the blur of lens and sensor.
BLUR_PX = 3.0
# Of rounding to whole grey levels.
ROUNDING_VARIANCE = 1 / 12
STEP = 1e-6


@dataclass(frozen=True)
class Sightings:
    """Places of the reference frame and what their pixels tell of them.

    Attributes:
        raw: (N, 2) pixels.
        information: (N, 2, 2) of their position, per square pixel.
    """

    raw: Floats
    information: Floats


def displacement_bound(
    inputs: LoadedInputs, recording: Recording, solution: Solution, *, target: Target, noise: tuple[float, float]
) -> float:
    """Return the least standard deviation, metres: root mean square over P1 and P2 along x and y.

    Args:
        noise: of the sensor: standard deviation in the dark, and variance per grey level.
    """
    luma = read_frame(inputs.video, inputs.project.reference_frame).luma
    pose, lens = solution.reference.pose, solution.lens
    height = solution.heights_m[target.name]
    assert pose is not None
    assert height is not None
    seen = recording.reference.targets_raw[target.name]
    on_roof = patches(luma, seen, noise) if seen.ndim == 2 else strips(luma, seen, noise)
    on_ground = patches(luma, recording.reference.ground_raw, noise)
    body = rest_body(recording, target.name, lens=lens, pose0=pose, z_m=height)

    def sight(at: Sightings, z_m: float, moves: bool) -> Callable[[Floats], Floats]:
        plan = intersect_height(pose.R, pose.centre_m, lens.rays_from_raw(at.raw), z_m)

        def raw_of(unknown: Floats) -> Floats:
            shift, turn = (unknown[:2], float(unknown[2])) if moves else (np.zeros(2), 0.0)
            moved = (plan - body.centre) @ rotation_2d(turn).T + body.centre + shift
            world = np.column_stack([moved, np.full(len(moved), z_m)])
            return lens.raw_from_rays(project(exponential(unknown[3:]) @ pose.R, pose.centre_m, world))

        return raw_of

    fisher = _fisher(sight(on_roof, height, True), on_roof) + _fisher(sight(on_ground, 0.0, False), on_ground)
    covariance = np.linalg.inv(fisher)[:3, :3]
    variances = []
    for arm in body.places - body.centre:
        lever = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]]])
        variances.append(np.diag(lever @ covariance @ lever.T))
    return float(np.sqrt(np.mean(variances)))


def camera_bound(inputs: LoadedInputs, recording: Recording, solution: Solution, noise: tuple[float, float]) -> Floats:
    """Return the least standard deviation (3,) of the camera's position from one frame's ground, metres.

    Rotation and position are both unknown here, as they are for a single pose: what a smooth flight starts from.
    """
    luma = read_frame(inputs.video, inputs.project.reference_frame).luma
    pose, lens = solution.reference.pose, solution.lens
    assert pose is not None
    at = patches(luma, recording.reference.ground_raw, noise)
    rays, J = jacobians(pose.R[None], pose.centre_m[None], solution.ground.points_m)
    slopes = lens.jacobian_raw_rays(rays[0]) @ J[0]
    fisher = np.einsum("niu,nij,njv->uv", slopes, at.information, slopes)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(fisher))[3:]))


def _fisher(raw_of: Callable[[Floats], Floats], at: Sightings) -> Floats:
    """Return the information (6, 6) on roof shift, roof rotation and camera rotation."""
    slopes = [(raw_of(STEP * unit) - raw_of(-STEP * unit)) / (2 * STEP) for unit in np.eye(6)]
    J = np.stack(slopes, axis=-1)
    return np.asarray(np.einsum("niu,nij,njv->uv", J, at.information, J))


def strips(luma: Luma, edges_raw: Floats, noise: tuple[float, float]) -> Sightings:
    """Return what strips tell across themselves, from edges (lines, stations, 2, 2) in raw pixels.

    The profile across is averaged over all stations, so that its gradient is the strip's and not the noise's.
    """
    places, tensors = [], []
    for edges in edges_raw:
        edges = edges[np.isfinite(edges).all(axis=(1, 2))]
        middle = edges.mean(axis=1)
        along = middle[-1] - middle[0]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        half = np.abs((edges[:, 1] - edges[:, 0]) @ normal).mean() / 2 + BLUR_PX
        across = np.arange(-np.ceil(half), np.ceil(half) + 1)
        samples = (middle[:, None] + across[:, None] * normal).astype(np.float32)
        values = cv2.remap(luma, samples[..., 0], samples[..., 1], cv2.INTER_CUBIC)
        profile = np.asarray(values, dtype=np.float64).mean(axis=0)
        gradient = np.gradient(profile)
        per_pixel = float((gradient**2 / _variance(profile, noise)).sum())
        pixels = float(np.linalg.norm(along)) / (len(middle) - 1)
        places.append(middle)
        tensors.append(np.broadcast_to(per_pixel * pixels * np.outer(normal, normal), (len(middle), 2, 2)))
    return Sightings(np.concatenate(places), np.concatenate(tensors))


def patches(luma: Luma, raw: Floats, noise: tuple[float, float]) -> Sightings:
    """Return what square patches tell of their places (N, 2); noise in their gradients makes the bound a little low."""
    grey = luma.astype(np.float64)
    v_gradient, u_gradient = (np.asarray(part) for part in np.gradient(grey))
    variance = _variance(grey, noise)
    side = (2 * HALF_PX + 1, 2 * HALF_PX + 1)
    at = np.clip(np.rint(raw).astype(int), 0, np.array(luma.shape[::-1]) - 1)

    def summed(values: Floats) -> Floats:
        boxes = cv2.boxFilter(values / variance, -1, side, normalize=False)
        return np.asarray(boxes[at[:, 1], at[:, 0]])

    uu, uv, vv = summed(u_gradient**2), summed(u_gradient * v_gradient), summed(v_gradient**2)
    return Sightings(raw, np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2))


def _variance(grey: Floats, noise: tuple[float, float]) -> Floats:
    read, shot = noise
    return np.asarray(read**2 + shot * np.maximum(grey, 0.0) + ROUNDING_VARIANCE)
