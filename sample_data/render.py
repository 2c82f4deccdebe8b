"""Scene to video: expose, add the sensor's noise, encode; one thread renders ahead while another encodes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
from numpy.typing import NDArray

from sample_data.exposure import Camera
from sample_data.scene import TIME_BASE_HZ, Recording, Scene

Image = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Watcher = Callable[[int, int], None]

_NOISE_MARGIN_PX = 509
_AHEAD = 2


class Noise:
    """Read and shot noise: one large field of random numbers, seen through a window that lies elsewhere each frame."""

    def __init__(self, scene: Scene, rng: np.random.Generator):
        rows, columns = scene.lens.image_size_px[::-1]
        self._field = rng.standard_normal((rows + _NOISE_MARGIN_PX, columns + _NOISE_MARGIN_PX), dtype=np.float32)
        self._read, self._shot = scene.sensor.read_noise, scene.sensor.shot_noise
        self._rng = rng

    def add(self, luma: Image) -> Image:
        """Return the image with noise of variance read² + shot * grey level."""
        row, column = self._rng.integers(0, _NOISE_MARGIN_PX, 2)
        forwards = bool(self._rng.integers(0, 2))
        field = self._field[row : row + luma.shape[0], column : column + luma.shape[1]]
        sigma = np.maximum(luma, 0)
        sigma *= np.float32(self._shot)
        sigma += np.float32(self._read**2)
        np.sqrt(sigma, out=sigma)
        sigma *= field
        return luma + sigma if forwards else luma - sigma


def frames(scene: Scene) -> Iterator[Bytes]:
    """Yield each frame as planar YUV 4:2:0, (rows * 3 / 2, columns) bytes, upright."""
    camera = Camera(scene)
    noise = Noise(scene, np.random.default_rng([scene.seed, 11]))
    for time_s in scene.frame_times():
        luma, chroma = camera.expose(float(time_s))
        gain = np.float32(scene.light.exposure(np.array([time_s]))[0])
        luma *= gain
        yield planes(noise.add(luma), chroma * gain)


def planes(luma: Image, chroma: Image) -> Bytes:
    """Return luma (rows, columns) and chroma offsets (rows / 2, columns / 2, 2) as one 4:2:0 image."""
    rows, columns = luma.shape
    frame = np.empty((rows * 3 // 2, columns), np.uint8)
    frame[:rows] = _bytes(luma)
    frame[rows:] = _bytes(chroma + 128).transpose(2, 0, 1).reshape(rows // 2, columns)
    return frame


def _bytes(values: Image) -> Bytes:
    return np.clip(values + np.float32(0.5), 0, 255).astype(np.uint8)


def write_video(scene: Scene, file: Path, watch: Watcher = lambda done, total: None, threads: int = 2) -> None:
    """Render and encode the whole clip."""
    encode(_ahead(frames(scene)), scene.frame_times(), scene.recording, file, watch=watch, threads=threads)


def encode(
    images: Iterable[Bytes],
    times_s: NDArray[np.float64],
    recording: Recording,
    file: Path,
    *,
    watch: Watcher = lambda done, total: None,
    threads: int = 2,
) -> None:
    """Write upright 4:2:0 images, one for each time, as a video."""
    rate = Fraction(recording.rate_hz).limit_denominator(1001)
    with av.open(str(file), "w") as container:
        stream = cast(
            av.VideoStream, container.add_stream(recording.codec, rate=rate, options=_encoder_options(recording))
        )
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = recording.bit_rate
        stream.time_base = Fraction(1, TIME_BASE_HZ)
        stream.codec_context.time_base = Fraction(1, TIME_BASE_HZ)
        stream.codec_context.thread_count = threads
        for number, (time_s, upright) in enumerate(zip(times_s, images, strict=True)):
            image = _on_its_side(upright) if recording.turned else upright
            if number == 0:
                stream.width, stream.height = image.shape[1], image.shape[0] * 2 // 3
            frame = av.VideoFrame.from_ndarray(image, format="yuv420p")
            frame.pts = round(time_s * TIME_BASE_HZ)
            frame.time_base = Fraction(1, TIME_BASE_HZ)
            container.mux(stream.encode(frame))
            watch(number + 1, len(times_s))
        container.mux(stream.encode(None))
    if recording.turned:
        _set_rotation_flag(file)


def _encoder_options(recording: Recording) -> dict[str, str]:
    if recording.codec == "libx265":
        # x265 numbers its threads by the machine; a fixed pool keeps the file the same everywhere.
        return {"preset": "ultrafast", "x265-params": "log-level=error:pools=2:frame-threads=1", **recording.options}
    # No buffer model (maxrate, bufsize): with several threads x264 keeps to it differently from run to run.
    return {"preset": "superfast", "g": "30", **recording.options}


def _ahead(source: Iterator[Bytes]) -> Iterator[Bytes]:
    """Yield what the source yields, computed a little ahead in another thread (cv2 and x264 leave Python's lock)."""
    with ThreadPoolExecutor(1) as pool:
        waiting: list[Future[Bytes | None]] = [pool.submit(next, source, None) for _ in range(_AHEAD)]
        while (image := waiting.pop(0).result()) is not None:
            waiting.append(pool.submit(next, source, None))
            yield image


def _on_its_side(image: Bytes) -> Bytes:
    """Return an upright 4:2:0 image turned a quarter counter-clockwise, as a sensor held on its side reads it."""
    columns = image.shape[1]
    rows = image.shape[0] * 2 // 3
    luma = np.rot90(image[:rows])
    colours = [np.rot90(plane) for plane in image[rows:].reshape(2, rows // 2, columns // 2)]
    return np.concatenate((luma.reshape(-1), *(plane.reshape(-1) for plane in colours))).reshape(-1, rows)


def _set_rotation_flag(file: Path) -> None:
    """Write a clockwise quarter turn into the track header, the place where cameras put it (ISO 14496-12, tkhd)."""
    content = bytearray(file.read_bytes())
    header = content.rindex(b"tkhd")
    version = content[header + 4]
    matrix = header + 4 + 4 + (32 if version == 1 else 20) + 16
    one = 1 << 16
    height_fixed = struct.unpack_from(">I", content, matrix + 40)[0]
    struct.pack_into(">9i", content, matrix, 0, one, 0, -one, 0, 0, height_fixed, 0, 1 << 30)
    file.write_bytes(bytes(content))
