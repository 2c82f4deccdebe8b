"""Make a whole project folder: video, survey, decisions, truth."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2

from sample_data.catalogue import SCENES, build
from sample_data.render import Watcher, write_video
from sample_data.scene import Scene
from sample_data.survey import write_survey


def make(scene: Scene, folder: Path, watch: Watcher = lambda done, total: None) -> None:
    """Render a scene into a project folder, made if need be; the video comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    write_survey(scene, folder)
    write_video(scene, folder / "video.mp4", watch)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m sample_data SCENE FOLDER`."""
    parser = argparse.ArgumentParser(prog="python -m sample_data", description="Render a scene with exact truth.")
    parser.add_argument("scene", choices=sorted(SCENES), help="name in the catalogue")
    parser.add_argument("folder", type=Path, help="where the project folder is made")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", help="WIDTHxHEIGHT of the video, upright; the field of view stays")
    parser.add_argument("--seconds", type=float, help="length of the clip")
    parser.add_argument("--preset", help="of the encoder, such as medium; the scene's own if left out")
    parser.add_argument("--threads", type=int, default=2, help="of image operations")
    parser.add_argument("--shipped", action="store_true", help="leave out truth.npz, which only tests read")
    chosen = parser.parse_args(arguments)
    cv2.setNumThreads(chosen.threads)
    size = tuple(int(part) for part in chosen.size.split("x")) if chosen.size else None
    scene = build(chosen.scene, seed=chosen.seed, size_px=size, duration_s=chosen.seconds, preset=chosen.preset)
    started = time.monotonic()

    def watch(done: int, total: int) -> None:
        seconds = time.monotonic() - started
        sys.stderr.write(f"\r{chosen.scene}: frame {done} of {total}, {seconds / done:.2f} s a frame ")
        sys.stderr.flush()

    make(scene, chosen.folder, watch)
    if chosen.shipped:
        (chosen.folder / "truth.npz").unlink()
    sys.stderr.write("\n")
    return 0
