"""A scanned site that is known exactly: a building on uneven ground, in the coordinates of a national grid."""

from __future__ import annotations

import numpy as np

from core.cloud import Cloud, make_cloud

# A UTM zone in Japan: in float32 the northing would come in steps of a quarter of a metre.
ORIGIN = np.array([651_234.0, 3_872_345.0, 113.0])
SLOPE = np.array([0.010, -0.005])
ROOF_M = 18.3
NOISE_M = 0.004


def relief(xy: np.ndarray) -> np.ndarray:
    """Ground of a few centimetres, waves of ten metres and more."""
    return 0.04 * np.sin(xy[..., 0] / 2.1) * np.cos(xy[..., 1] / 1.7)


def site(count: int = 200_000, seed: int = 0) -> Cloud:
    """A building on uneven ground, scanned more densely near its middle; half of all points on roof and walls."""
    random = np.random.default_rng(seed)
    ground = random.uniform(-20, 20, (count // 2, 2)) * np.sqrt(random.uniform(0.15, 1, (count // 2, 1)))
    ground = ground[(np.abs(ground) > [6, 4]).any(axis=1)]
    roof = random.uniform((-6, -4), (6, 4), (count // 3, 2))
    wall = random.uniform((-6, 0), (6, ROOF_M), (count // 6, 2))
    ground_z = relief(ground) + ground @ SLOPE + random.normal(0, NOISE_M, len(ground))
    roof_z = ROOF_M + random.normal(0, NOISE_M, len(roof))
    points = np.concatenate(
        [
            np.column_stack([ground, ground_z]),
            np.column_stack([roof, roof_z]),
            np.column_stack([wall[:, 0], np.full(len(wall), 4.0), wall[:, 1]]),
            # Stray echoes below the ground.
            np.column_stack([random.uniform(-15, 15, (200, 2)), random.uniform(-6, -1, 200)]),
        ]
    )
    return make_cloud(points + ORIGIN)
