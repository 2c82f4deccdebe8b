"""Reference frames as the engine measures them, kept while they are being drawn on."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from app.frames import Fingerprint
from core.video import Luma, read_frame


@lru_cache(maxsize=3)
def luma_of(video: Fingerprint, number: int) -> Luma:
    """Return the luma plane of a frame.

    Raises:
        InputError: there is no such frame.
    """
    return read_frame(Path(video[0]), number).luma
