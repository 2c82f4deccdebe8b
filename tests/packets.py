"""Videos whose packets have been tampered with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av


def repacked(source: Path, target: Path, edit: Callable[[int, bytes], bytes | None]) -> Path:
    """Copy a video packet by packet; `edit` is given each one's place in the file and its data, None drops it."""
    with av.open(str(source)) as given, av.open(str(target), "w") as made:
        stream = given.streams.video[0]
        copy = made.add_stream_from_template(stream)
        for number, packet in enumerate(packet for packet in given.demux(stream) if packet.pts is not None):
            data = edit(number, bytes(packet))
            if data is None:
                continue
            changed = av.Packet(data)
            changed.pts, changed.dts, changed.time_base = packet.pts, packet.dts, packet.time_base
            changed.duration, changed.is_keyframe, changed.stream = packet.duration, packet.is_keyframe, copy
            made.mux(changed)
    return target
