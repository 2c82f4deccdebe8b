"""Reference frames as the engine measures them, kept while they are being drawn on."""

from __future__ import annotations

import contextlib
import threading
from functools import lru_cache

from app.frames import Fingerprint, file_of
from core.errors import InputError
from core.video import Luma, read_frame

# Whoever asks for a frame that is just being decoded waits for it, and does not decode it too.
_decoding = threading.Lock()


def luma_of(video: Fingerprint, number: int) -> Luma:
    """Return the luma plane of a frame.

    Raises:
        InputError: there is no such frame.
    """
    with _decoding:
        return _luma_of(video, number)


def prepare_luma(video: Fingerprint, number: int) -> None:
    """Have a frame decoded, since somebody opened the page on which it will be drawn on."""

    def decode() -> None:
        with contextlib.suppress(InputError):
            luma_of(video, number)

    threading.Thread(target=decode, name="reference luma", daemon=True).start()


@lru_cache(maxsize=3)
def _luma_of(video: Fingerprint, number: int) -> Luma:
    return read_frame(file_of(video), number).luma
