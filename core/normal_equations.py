"""Normal equations of least squares: small ones, of many frames at once."""

from __future__ import annotations

import numpy as np

from core.coordinates import Floats

# Added to matrices of unit diagonal: what points do not tell stays where it was.
RIDGE = 1e-10


def solve_damped(A: Floats, g: Floats) -> Floats:
    """Return the steps (F, U) that solve A x = g for normal matrices (F, U, U) and right sides (F, U).

    Each system is scaled first. Frames whose points do not tell all unknowns take the smallest step that fits; those
    without any usable point take none instead of failing all.
    """
    scale = np.sqrt(np.maximum(np.diagonal(A, axis1=-2, axis2=-1), 1e-300))
    scaled = A / (scale[..., :, None] * scale[..., None, :]) + RIDGE * np.eye(A.shape[-1])
    usable = np.isfinite(scaled).all(axis=(-2, -1)) & (np.abs(A).max(axis=(-2, -1)) > 0)
    scaled[~usable] = np.eye(A.shape[-1])
    step = np.linalg.solve(scaled, (g / scale)[..., None])[..., 0] / scale
    return np.where(usable[:, None] & np.isfinite(step), step, 0.0)
