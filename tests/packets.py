"""Videos whose packets or display matrix have been tampered with."""

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


def shown_by(file: Path, matrix: tuple[float, float, float, float]) -> None:
    """Set the four numbers of an MP4 file's display matrix that turn, stretch and mirror."""
    one = 1 << 16
    a, b, c, d = (round(one * number) for number in matrix)
    as_filmed, shown = (
        b"".join(value.to_bytes(4, "big", signed=True) for value in numbers)
        for numbers in ((one, 0, 0, 0, one, 0, 0, 0, 1 << 30), (a, b, 0, c, d, 0, 0, 0, 1 << 30))
    )
    content = file.read_bytes()
    at = content.index(as_filmed, content.index(b"tkhd"))
    file.write_bytes(content[:at] + shown + content[at + len(shown) :])
