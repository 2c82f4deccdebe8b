"""How fast the engine is, as multiples of what decoding alone takes on the same machine, and how much memory it needs.

`python -m sample_data.bench [--sizes 3840x2160,1920x1080] [--codecs libx264,libx265] [--frames 300] [--write]`.

The clip is a few rendered seconds, played forwards and backwards so that nothing jumps, encoded once for each codec and
repeated without encoding it again. Every figure comes from a process of its own; decoding, engine and
workers take turns, and ratios are the medians of the ratios of such turns. On a machine that others use as well, a turn
waits for a quiet moment and is repeated when somebody broke into it.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import pickle
import shutil
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import av
import cv2
import numpy as np

import core.measure as measuring
from core.chunks import WARM_UP, Chunk, processes_for
from core.following import LinesFollower
from core.ground import GroundTracker
from core.measure import PreparedVideo, make_measurer, measure, measure_chunk, measure_order
from core.measurements import MeasurementStore
from core.parallel import available_cores
from core.run import FRAMES_FILE, load_inputs, run_project
from core.solve import solve
from core.storage import state_of
from core.video import frame_index, luma_of, read_frame, read_frames
from core.workers import Order
from sample_data.catalogue import SCENES, compose
from sample_data.published import PublishedMethod
from sample_data.render import encode, frames
from sample_data.survey import write_survey
from sample_data.tables import README, markdown_table, write_between_markers

CACHE = Path("workspace/bench")
# Rendered frames of a clip; forwards and backwards they last twice as long.
RENDERED = 75
CODEC_NAMES = {"libx264": "H.264", "libx265": "H.265"}
# Share of the machine that others may use while something is measured, how often it is tried again, how long waited.
QUIET = 0.05
TRIES = 3
LONGEST_WAIT_S = 60
EMPTY_TASKS = 500
# Frames measured by the engine's `paper` for each one measured as the paper's text reads.
PAPER_BY_PUBLISHED = 15
BIT_RATE_4K = {"libx264": 45_000_000, "libx265": 30_000_000}
PIXELS_4K = 3840 * 2160


# --- the clip --------------------------------------------------------------------------------------------------------


def make_clip(folder: Path, size: tuple[int, int], codec: str, count: int) -> Path:
    """Return a project folder whose video has `count` frames, made if it is not there yet."""
    unit = folder / f"{size[0]}x{size[1]}-{codec}"
    if not (unit / "video.mp4").exists():
        _make_unit(unit, size, codec)
    project = folder / f"{unit.name}-{count}"
    if not (project / "video.mp4").exists():
        project.mkdir(parents=True, exist_ok=True)
        for file in ("project.json", "site.laz", "lens.yaml", "gps.csv"):
            shutil.copy(unit / file, project)
        _repeat(unit / "video.mp4", project / "video.mp4", count)
    return project


def _make_unit(unit: Path, size: tuple[int, int], codec: str) -> None:
    share = size[0] * size[1] / PIXELS_4K
    seconds = RENDERED / 30
    brief = replace(
        SCENES["eq7"],
        size_px=size,
        pre_event_s=0.4 * seconds,
        event_s=0.4 * seconds,
        post_event_s=0.2 * seconds,
        ringing_s=0.1,
    )
    recording = replace(brief.recording, codec=codec, bit_rate=int(BIT_RATE_4K[codec] * share))
    scene = compose("bench", replace(brief, recording=recording), 1)
    unit.mkdir(parents=True, exist_ok=True)
    write_survey(scene, unit)
    kept = np.memmap(unit / "frames.raw", np.uint8, "w+", shape=(RENDERED, size[1] * 3 // 2, size[0]))
    try:
        for number, image in enumerate(frames(scene)):
            kept[number] = image
            _say(f"{unit.name}: rendering frame {number + 1} of {RENDERED}")
        both_ways = [*range(RENDERED), *reversed(range(RENDERED))]
        times = np.arange(len(both_ways)) / recording.rate_hz
        unfinished = unit / "unfinished.mp4"
        encode((np.asarray(kept[number]) for number in both_ways), times, recording, unfinished)
        unfinished.rename(unit / "video.mp4")
    finally:
        del kept
        (unit / "frames.raw").unlink()


def _repeat(source: Path, target: Path, count: int) -> None:
    """Repeat a video's packets until there are `count` frames; it begins with a closed group, so this is seamless."""
    written, turn = 0, 0
    with av.open(str(target), "w") as out:
        stream = None
        while written < count:
            with av.open(str(source)) as clip:
                shown = clip.streams.video[0]
                stream = stream or out.add_stream_from_template(shown)
                packets = [packet for packet in clip.demux(shown) if packet.pts is not None]
                times = sorted(packet.pts or 0 for packet in packets)
                length = len(packets) * (times[1] - times[0])
                for packet in packets[: count - written]:
                    assert packet.pts is not None
                    assert packet.dts is not None
                    packet.pts += turn * length
                    packet.dts += turn * length
                    packet.stream = stream
                    out.mux(packet)
                    written += 1
            turn += 1


# --- what is measured, each in a process of its own -----------------------------------------------------------------


def decode(folder: Path, count: int) -> dict[str, Any]:
    """Decode with all cores and look at each luma plane: the floor.

    With as many threads as there are cores, and with as many as FFmpeg chooses; the faster of them counts.
    """
    fastest, number = float("inf"), 0
    for threads in (available_cores(), 0):
        started = time.perf_counter()
        number = 0
        with av.open(str(folder / "video.mp4")) as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_type = "AUTO"
            stream.codec_context.thread_count = threads
            for picture in container.decode(stream):
                luma_of(picture)
                number += 1
        fastest = min(fastest, time.perf_counter() - started)
    return {"frame_ms": fastest / number * 1e3, "frames": number}


def engine(folder: Path, count: int, **how: Any) -> dict[str, Any]:
    """Run the engine's pass over the video, from opening it to the last commit, then solve."""
    inputs = load_inputs(folder)
    with _stopwatches() as spent, MeasurementStore(folder / "results" / f"bench-{FRAMES_FILE}") as store:
        started = time.perf_counter()
        number = measure(inputs.setup(), store, fresh=True, **how)
        measuring = time.perf_counter() - started
        recording = store.load(number)
        started = time.perf_counter()
        solve(recording, inputs.project, inputs.lens, inputs.relief)
        solving = time.perf_counter() - started
    total = len(recording.frame)
    (folder / "results" / f"bench-{FRAMES_FILE}").unlink()
    return {
        "frame_ms": measuring / total * 1e3,
        "frames": total,
        "solve_s": solving,
        "stages_ms": {stage: seconds / total * 1e3 for stage, seconds in spent.items()},
    }


def two_workers(folder: Path, count: int) -> dict[str, Any]:
    """Run the engine in two processes at most."""
    return engine(folder, count, workers=2)


def one_process(folder: Path, count: int) -> dict[str, Any]:
    """Run the engine in one process, however few cores that keeps busy."""
    return engine(folder, count, workers=1)


def two_processes(folder: Path, count: int) -> dict[str, Any]:
    """Run the engine in two processes, even where it would take one."""
    with patch.object(measuring, "processes_for", lambda *_, **__: 2):
        return engine(folder, count)


def two_on_dask(folder: Path, count: int) -> dict[str, Any]:
    """Run the engine on two workers of a Dask cluster on this machine, which has been started before."""
    with _dask() as cluster:
        return engine(folder, count, scheduler=cluster.scheduler_address)


@contextmanager
def _dask() -> Iterator[Any]:
    """Start two workers of Dask as `core/CLUSTER.md` says, without Dask's profiler."""
    # Loads for a while, which is no part of what the others do.
    import dask
    from distributed import LocalCluster

    how = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.ERROR}
    with dask.config.set({"distributed.worker.profile.enabled": False}), LocalCluster(**how) as cluster:
        yield cluster


@contextmanager
def _stopwatches() -> Iterator[dict[str, float]]:
    """Measure the time spent in the stages of the pass."""
    spent: dict[str, float] = defaultdict(float)
    stages: list[tuple[str, Any, str]] = [
        ("ground", GroundTracker, "find"),
        ("roof", LinesFollower, "find"),
        ("storing", MeasurementStore, "append"),
    ]

    def timed(stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            started = time.perf_counter()
            try:
                return work(*arguments, **named)
            finally:
                spent[stage] += time.perf_counter() - started

        return call

    before = [(owner, name, getattr(owner, name)) for _, owner, name in stages]
    for stage, owner, name in stages:
        setattr(owner, name, timed(stage, getattr(owner, name)))
    try:
        yield spent
    finally:
        for owner, name, work in before:
            setattr(owner, name, work)


def published(folder: Path, count: int) -> dict[str, Any]:
    """Measure some frames the published way, over whole frames."""
    inputs = load_inputs(folder)
    method = PublishedMethod(inputs, read_frame(inputs.video, inputs.project.reference_frame).luma)
    measured = 0
    started = time.perf_counter()
    for frame in read_frames(inputs.video, 1, 1 + count):
        measured += method.displacement(frame.luma) is not None
    return {"frame_ms": (time.perf_counter() - started) / count * 1e3, "frames": count, "measured": measured}


def paper(folder: Path, count: int) -> dict[str, Any]:
    """Measure some frames by the engine's own `paper`: more of them, since it searches the first one for the roof."""
    count = PAPER_BY_PUBLISHED * count
    inputs = load_inputs(folder)
    inputs = replace(inputs, project=inputs.project.model_copy(update={"method": "paper"}))
    measurer = make_measurer(inputs.setup())
    started = time.perf_counter()
    found = list(measure_chunk(inputs.setup(), Chunk(0, count), measurer=measurer))
    measured = sum(frame.apparent["roof"] is not None for frame in found)
    return {"frame_ms": (time.perf_counter() - started) / count * 1e3, "frames": count, "measured": measured}


def costs(folder: Path, count: int) -> dict[str, Any]:
    """Measure what a campaign is planned with, in seconds of one core and in bytes; see `core/CLUSTER.md`."""
    from distributed import Client

    cv2.setNumThreads(1)
    inputs = load_inputs(folder)
    setup, index = inputs.setup(), frame_index(inputs.video)
    with _core_seconds() as decoding:
        total = sum(1 for _ in read_frames(inputs.video, threads=1))
    with _core_seconds() as looking:
        measurer = make_measurer(setup)
    prepared = pickle.dumps(PreparedVideo(setup, index, measurer))
    first = index.key_frames[-1] + WARM_UP
    with _core_seconds() as beginning:
        list(measure_order(Order(prepared, Chunk(first, first + 1))))
    with _core_seconds() as measuring:
        found = list(measure_order(Order(prepared, Chunk(0, total))))
    run_project(folder)
    with _core_seconds() as writing:
        run_project(folder)
    with _dask() as cluster, Client(cluster) as client:
        started = time.perf_counter()
        client.gather(client.map(len, [prepared] * EMPTY_TASKS, pure=False))
        empty_ms = (time.perf_counter() - started) / EMPTY_TASKS * 1e3
    return {
        "frame_ms": measuring[0] / total * 1e3,
        "decode_ms": decoding[0] / total * 1e3,
        "reference_s": looking[0],
        "begin_s": beginning[0],
        "solve_and_write_s": writing[0],
        "empty_task_ms": empty_ms,
        "video_bytes": state_of(inputs.video).size / total,
        "task_bytes": len(prepared),
        "result_bytes": len(pickle.dumps(found)) / total,
        "stored_bytes": (folder / "results" / FRAMES_FILE).stat().st_size / total,
    }


@contextmanager
def _core_seconds() -> Iterator[list[float]]:
    """Measure how long cores are busy for this process."""
    spent: list[float] = []
    started = time.process_time()
    yield spent
    spent.append(time.process_time() - started)


PARTS = {
    part.__name__: part
    for part in (decode, engine, two_workers, one_process, two_processes, two_on_dask, published, paper, costs)
}


def peak_memory_mb() -> float:
    """Return the largest resident size this process has had; nan where the system does not tell."""
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    # Not getrusage: its maximum counts the parent before this program was loaded.
    line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return float(line.split()[1]) / 1024


def in_own_process(part: str, folder: Path, count: int = 0) -> dict[str, Any]:
    """Return what a part measures, with the peak memory of its process and how busy others kept the machine."""
    # Not as the main module: whatever that imports, each helping process would load again.
    program = "import sys; from sample_data.bench import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "--part", part, str(folder), "--frames", str(count)]
    started, others = time.perf_counter(), _busy_s() - _own_s()
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    others_s = _busy_s() - _own_s() - others
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    result["others"] = max(0.0, others_s) / (time.perf_counter() - started) / available_cores()
    said = f"{folder.name}: {part} {result['frame_ms']:.1f} ms a frame, {result['memory_mb']:.0f} MB"
    _say(said + (f", others {100 * result['others']:.0f} %" if result["others"] > QUIET else ""))
    return result


def turn(parts: Sequence[str], folder: Path, count: int = 0) -> dict[str, dict[str, Any]]:
    """Return what the parts measure one after another in a quiet moment, or in the least disturbed one of some."""
    best: dict[str, dict[str, Any]] = {}
    for _ in range(TRIES):
        _wait_for_quiet()
        found = {part: in_own_process(part, folder, count) for part in parts}
        if not best or _disturbance(found) < _disturbance(best):
            best = found
        if _disturbance(best) <= QUIET:
            break
    return best


def _disturbance(found: Mapping[str, Mapping[str, Any]]) -> float:
    return max(one["others"] for one in found.values())


def _wait_for_quiet() -> None:
    for _ in range(LONGEST_WAIT_S):
        before = _busy_s()
        time.sleep(1.0)
        if (_busy_s() - before) / available_cores() <= QUIET:
            return


def _busy_s() -> float:
    """Return how long the cores of this machine have been busy; 0 where the system does not tell."""
    file = Path("/proc/stat")
    if not file.exists():
        return 0.0
    user, nice, system, _, _, irq, soft_irq = (int(ticks) for ticks in file.read_text().split()[1:8])
    return (user + nice + system + irq + soft_irq) / os.sysconf("SC_CLK_TCK")


def _own_s() -> float:
    """Return how long this process and those it has waited for have been busy."""
    return sum(os.times()[:4])


# --- the table -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bench:
    """Figures of one clip; times in ms a frame, medians.

    Attributes:
        workers_ms, dask_ms: two processes at most, two workers of Dask.
        workers_ratio, dask_ratio: by the engine's own choice, and by two processes at most.
        long_ms, long_sharing_ratio, long_dask_ratio: on ten times the frames; two processes in any case, by one.
        memory_mb, long_memory_mb: peak, on the clip and on ten times the frames.
        stages_ms: ground, roof, storing; the rest of `engine_ms` is waiting for frames.
    """

    name: str
    decode_ms: float
    engine_ms: float
    ratio: float
    workers_ms: float
    workers_ratio: float
    dask_ms: float
    dask_ratio: float
    long_ms: float
    long_sharing_ratio: float
    long_dask_ratio: float
    memory_mb: float
    long_memory_mb: float
    published_ms: float
    paper_ms: float
    paper_ratio: float
    solve_s: float
    stages_ms: dict[str, float]


def bench(
    size: tuple[int, int], codec: str, *, count: int, runs: int, slow_frames: int, long_factor: int, cache: Path
) -> Bench:
    """Measure one size and codec."""
    clip = make_clip(cache, size, codec, count)
    turns = [turn(("decode", "engine"), clip) for _ in range(runs)]
    side_by_side = [turn(("engine", "two_workers", "two_on_dask"), clip) for _ in range(max(1, (runs + 1) // 2))]
    by_paper = [turn(("published", "paper"), clip, slow_frames) for _ in range(max(1, (runs + 1) // 2))]
    long_clip = make_clip(cache, size, codec, long_factor * count)
    long = turn(("engine", "one_process", "two_processes", "two_on_dask"), long_clip)
    (long_clip / "video.mp4").unlink()

    def median(taken: Sequence[Mapping[str, Any]], part: str, by: str | None = None) -> float:
        return statistics.median(one[part]["frame_ms"] / (one[by]["frame_ms"] if by else 1.0) for one in taken)

    engines = [one["engine"] for one in turns]
    return Bench(
        name=f"{size[0]}×{size[1]} {CODEC_NAMES[codec]}",
        decode_ms=median(turns, "decode"),
        engine_ms=median(turns, "engine"),
        ratio=median(turns, "engine", by="decode"),
        workers_ms=median(side_by_side, "two_workers"),
        workers_ratio=median(side_by_side, "two_workers", by="engine"),
        dask_ms=median(side_by_side, "two_on_dask"),
        dask_ratio=median(side_by_side, "two_on_dask", by="two_workers"),
        long_ms=median([long], "engine"),
        long_sharing_ratio=median([long], "two_processes", by="one_process"),
        long_dask_ratio=median([long], "two_on_dask", by="two_processes"),
        memory_mb=max(one["memory_mb"] for one in engines),
        long_memory_mb=long["engine"]["memory_mb"],
        published_ms=median(by_paper, "published"),
        paper_ms=median(by_paper, "paper"),
        paper_ratio=median(by_paper, "published", by="paper"),
        solve_s=statistics.median(one["solve_s"] for one in engines),
        stages_ms={
            stage: statistics.median(one["stages_ms"][stage] for one in engines) for stage in engines[0]["stages_ms"]
        },
    )


def table(results: Sequence[Bench], count: int, long_factor: int) -> str:
    """Return the table for people, a column for each clip."""
    rows: list[tuple[str, Callable[[Bench], str]]] = [
        ("decoding alone, ms a frame", lambda one: f"{one.decode_ms:.1f}"),
        ("engine, ms a frame", lambda one: f"{one.engine_ms:.1f}"),
        ("**engine by decoding alone**", lambda one: f"**{one.ratio:.2f}**"),
        ("of it: ground patches", lambda one: f"{one.stages_ms['ground']:.1f}"),
        ("of it: roof lines", lambda one: f"{one.stages_ms['roof']:.1f}"),
        ("of it: storing", lambda one: f"{one.stages_ms['storing']:.1f}"),
        (
            "of it: waiting for frames, and the reference frame",
            lambda one: f"{one.engine_ms - sum(one.stages_ms.values()):.1f}",
        ),
        ("engine, two workers", lambda one: f"{one.workers_ms:.1f}"),
        ("two workers by the engine's own choice", lambda one: f"{one.workers_ratio:.2f}"),
        ("engine, two workers of Dask", lambda one: f"{one.dask_ms:.1f}"),
        ("two workers of Dask by two", lambda one: f"{one.dask_ratio:.2f}"),
        (f"engine, {long_factor * count} frames", lambda one: f"{one.long_ms:.1f}"),
        (f"two processes by one, {long_factor * count} frames", lambda one: f"{one.long_sharing_ratio:.2f}"),
        (
            f"two workers of Dask by two processes, {long_factor * count} frames",
            lambda one: f"{one.long_dask_ratio:.2f}",
        ),
        (f"peak memory, {count} frames, MB", lambda one: f"{one.memory_mb:.0f}"),
        (f"peak memory, {long_factor * count} frames, MB", lambda one: f"{one.long_memory_mb:.0f}"),
        (f"solving {count} frames, s", lambda one: f"{one.solve_s:.2f}"),
        ("the paper as its text reads, ms a frame", lambda one: f"{one.published_ms:.0f}"),
        ("the engine's `paper`, ms a frame", lambda one: f"{one.paper_ms:.0f}"),
        ("speed-up of `paper`", lambda one: f"{one.paper_ratio:.1f}×"),
        ("speed-up of `geometric`", lambda one: f"{one.published_ms / one.engine_ms:.0f}×"),
    ]
    return markdown_table(["", *(one.name for one in results)], [[name, *map(value, results)] for name, value in rows])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m sample_data.bench`."""
    chosen = _parser().parse_args(arguments)
    if chosen.part:
        result = PARTS[chosen.part](chosen.folder, chosen.frames)
        print(json.dumps({**result, "memory_mb": peak_memory_mb()}))
        return 0
    cv2.setNumThreads(2)
    chosen.cache.mkdir(parents=True, exist_ok=True)
    results = []
    for size in chosen.sizes.split(","):
        for codec in chosen.codecs.split(","):
            if codec not in av.codecs_available:
                _say(f"{codec} is not in this build of FFmpeg; left out.")
                continue
            width, height = (int(part) for part in size.split("x"))
            results.append(
                bench(
                    (width, height),
                    codec,
                    count=chosen.frames,
                    runs=chosen.runs,
                    slow_frames=chosen.slow_frames,
                    long_factor=chosen.long_factor,
                    cache=chosen.cache,
                )
            )
            print(table(results[-1:], chosen.frames, chosen.long_factor), flush=True)
    text = table(results, chosen.frames, chosen.long_factor)
    text += f"\n\nMedians of {chosen.runs}, {os.cpu_count()} cores; rewritten by `make bench BENCH_OPTIONS=--write`."
    text += f" Of two workers, those that repay measure {chosen.frames} frames here: {_processes(chosen)}."
    print(text)
    if chosen.write:
        write_between_markers(README, "bench", f"\n{text}\n")
    return 0


def _processes(chosen: argparse.Namespace) -> str:
    """Say how many processes measure a clip of each size where there may be two."""
    counts = {}
    for size in chosen.sizes.split(","):
        width, height = (int(part) for part in size.split("x"))
        counts[size] = processes_for(chosen.frames, 2, available_cores(), pixels=width * height)
    return ", ".join(f"{count} at {size.replace('x', '×')}" for size, count in counts.items())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sample_data.bench", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help=argparse.SUPPRESS)
    parser.add_argument("--part", choices=sorted(PARTS), help=argparse.SUPPRESS)
    parser.add_argument("--sizes", default="3840x2160,1920x1080")
    parser.add_argument("--codecs", default="libx264,libx265")
    parser.add_argument("--frames", type=int, default=300, help="of a clip; memory is also measured on more")
    parser.add_argument("--long-factor", type=int, default=10, help="how much longer the long clip is")
    parser.add_argument("--runs", type=int, default=5, help="pairs of decoding and engine")
    parser.add_argument("--slow-frames", type=int, default=6, help="frames measured the published way")
    parser.add_argument("--cache", type=Path, default=CACHE, help="where clips are kept")
    parser.add_argument("--write", action="store_true", help="put the table into the README")
    return parser


def _say(text: str) -> None:
    sys.stderr.write(f"\r{text} \n" if not sys.stderr.isatty() else f"\r{text} ")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
