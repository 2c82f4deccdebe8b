"""What is known of a video: at once what its container says, and where every frame lies as soon as that was read.

A container's own tables tell size and rate. Where the frames lie is read from the packets, all of them: at two
gigabytes that takes seconds, in which nobody should look at an empty page.
"""

from __future__ import annotations

import contextlib
import threading
from functools import lru_cache

from app.events import Hub
from app.frames import Fingerprint, file_of, fingerprint
from app.store import ProjectFolder
from core.errors import InputError
from core.storage import File
from core.video import VideoInfo, frame_index, probe

# A file up to this size is read through in less time than a person notices.
_AT_ONCE_BYTES = 64 << 20
_read: set[Fingerprint] = set()
_being_read: set[Fingerprint] = set()
_lock = threading.Lock()


def video_info(path: File) -> VideoInfo:
    """Return what the video's container says, kept while the file stays.

    Raises:
        InputError: it cannot be used.
    """
    return _probed(fingerprint(path))


@lru_cache(maxsize=32)
def _probed(key: Fingerprint) -> VideoInfo:
    return probe(file_of(key))


def is_read_through(hub: Hub, folder: ProjectFolder, path: File) -> bool:
    """Whether it is known where every frame lies; if not, have it read and tell the project's tabs afterwards.

    Raises:
        InputError: the file is not there.
    """
    key = fingerprint(path)
    if key[1] <= _AT_ONCE_BYTES:
        return True
    with _lock:
        if key in _read or key in _being_read:
            return key in _read
        _being_read.add(key)

    def read() -> None:
        with contextlib.suppress(InputError):  # whoever asks for the frames is told what is wrong
            frame_index(path)
        with _lock:
            _being_read.discard(key)
            _read.add(key)
        hub.publish(folder.id, "inputs", {"kind": "video"})

    threading.Thread(target=read, name="video index", daemon=True).start()
    return False
