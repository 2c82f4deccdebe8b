"""Pictures that are known between their pixels too: sums of plane waves, none shorter than four pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from core.coordinates import Floats
from core.video import Luma

Picture = Callable[[Floats], Floats]


def waves(seed: int = 0, *, count: int = 60, shortest_px: float = 4.0, contrast: float = 28.0) -> Picture:
    """Return a texture: grey levels (...) at pixels (..., 2), mean 120, of a standard deviation."""
    random = np.random.default_rng(seed)
    length = shortest_px * 10 ** random.uniform(0, 1, count)
    direction = random.uniform(0, np.pi, count)
    k = 2 * np.pi / length * np.stack([np.cos(direction), np.sin(direction)])
    phase = random.uniform(0, 2 * np.pi, count)
    amplitude = contrast * np.sqrt(2 / count)

    def at(pixels: Floats) -> Floats:
        return np.asarray(120.0 + amplitude * np.cos(pixels @ k + phase).sum(axis=-1))

    return at


def pixels(size: tuple[int, int]) -> Floats:
    """Return (height, width, 2) coordinates of the pixels of a frame of (width, height)."""
    return np.stack(np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float)), axis=-1)


def frame(grey: Floats, noise: float = 0.0, seed: int = 0) -> Luma:
    """Return grey levels as a camera delivers them: noisy, whole, from 0 to 255."""
    if noise:
        grey = grey + np.random.default_rng(seed).normal(scale=noise, size=grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
