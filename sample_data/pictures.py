"""Remake the screenshots of the README: all eight steps, on the shipped sample, in a real browser.

`python -m sample_data.pictures [PROJECT]`: the project is copied, so nothing a person works on is touched, and
measured if it has no results yet.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from core.run import run_project

HERE = Path(__file__).parent
SAMPLE = HERE / "sample"
PICTURES = HERE / "screenshots"
SIZE_PX = (1440, 900)
# What a page shows while it waits for the engine.
BUSY = "progress, .pane-note"
# A picture with photographs in it would be larger than all others together; with a palette it is a third.
LARGE_BYTES = 400_000
COLOURS = 256
# Channels apart by more: an accent, a mark, a curve; not concrete.
VIVID = 70
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")


@dataclass(frozen=True)
class Shot:
    """One picture: which page, what must be there before the shutter, and how long it settles."""

    name: str
    step: str
    ready: str
    query: str = ""
    settles_s: float = 1.5
    dark: bool = False
    prepare: Callable[[Page], None] | None = None


SHOTS: tuple[Shot, ...] = (
    Shot("1-inputs", "inputs", "#main .card"),
    Shot("2-orthoimage", "orthoimage", "#main iframe", settles_s=15, prepare=lambda page: _look_closer(page)),
    Shot("3-correspondences", "correspondences", ".pane .shapes .mark", settles_s=4),
    Shot("4-regions", "regions", ".pane .shapes .polygon", settles_s=4),
    Shot("5-track", "track", ".plot-body canvas"),
    Shot("6-review", "review", ".review-frame[data-frame]", query="?frame={peak}", settles_s=3, dark=True),
    Shot("7-drift", "drift", ".drift-lower .plot-entry", settles_s=2.5),
    Shot("8-export", "export", ".comparison tbody tr", settles_s=2.5),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Remake all pictures."""
    parser = argparse.ArgumentParser(prog="python -m sample_data.pictures", description=__doc__)
    parser.add_argument("project", nargs="?", type=Path, default=SAMPLE, help="default: the shipped sample")
    parser.add_argument("--out", type=Path, default=PICTURES, help="folder of the pictures")
    parser.add_argument("--only", help="part of the name of the pictures to make")
    chosen = parser.parse_args(arguments)
    shots = [shot for shot in SHOTS if chosen.only is None or chosen.only in shot.name]
    with tempfile.TemporaryDirectory() as workspace:
        project = Path(workspace) / "sample"
        shutil.copytree(chosen.project, project)
        if not (project / "results" / "summary.json").exists():
            print("Measuring the sample")
            run_project(project)
        with _served(Path(workspace)) as address, _chromium() as browser:
            for shot in shots:
                file = _take(browser, f"{address}/p/sample/", shot, chosen.out)
                print(f"{file} {file.stat().st_size / 1e3:.0f} kB")
    return 0


def _take(browser: Browser, address: str, shot: Shot, folder: Path) -> Path:
    context = browser.new_context(
        viewport={"width": SIZE_PX[0], "height": SIZE_PX[1]}, color_scheme="dark" if shot.dark else "light"
    )
    page = context.new_page()
    page.set_default_timeout(120_000)
    peak = _peak_frame(page, address) if "{peak}" in shot.query else 0
    page.goto(f"{address}{shot.step}{shot.query.format(peak=peak)}")
    page.wait_for_selector(shot.ready)
    page.wait_for_timeout(1000 * shot.settles_s)
    page.wait_for_function(f"() => ![...document.querySelectorAll('{BUSY}')].some((one) => one.checkVisibility())")
    if shot.prepare is not None:
        shot.prepare(page)
    page.wait_for_timeout(500)
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    context.close()
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{shot.name}.png"
    picture.save(file, optimize=True)
    if file.stat().st_size > LARGE_BYTES:
        _few_colours(picture).save(file, optimize=True)
    return file


def _few_colours(picture: Image.Image) -> Image.Image:
    """Reduce to a palette that keeps the small vivid marks: they count for more than their share of the area."""
    pixels = np.asarray(picture).reshape(-1, 3)
    vivid = pixels[np.ptp(pixels.astype(np.int16), axis=1) > VIVID]
    plain = pixels[:: max(1, len(pixels) // 60_000)]
    white = np.full((len(plain) // 20, 3), 255, np.uint8)
    marks = np.resize(vivid, (len(plain), 3)) if len(vivid) else plain
    palette = Image.fromarray(np.concatenate((plain, marks, white))[None]).quantize(COLOURS)
    return picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)


def _look_closer(page: Page) -> None:
    """Turn to the building, and put away the viewer's word on machines without a graphics card."""
    scene = page.frame_locator("iframe")
    notice = scene.get_by_role("button", name="Close").or_(scene.locator(".mantine-Notification-closeButton"))
    if notice.count():
        notice.first.dispatch_event("click")  # it may still be sliding in
    box = page.locator("iframe").bounding_box()
    if box is None:
        return
    page.mouse.move(box["x"] + 0.48 * box["width"], box["y"] + 0.62 * box["height"])
    for _ in range(2):
        page.mouse.wheel(0, -240)
        page.wait_for_timeout(700)


def _peak_frame(page: Page, address: str) -> int:
    """Frame of the first target's largest displacement: where there is most to see."""
    api = address.replace("/p/", "/api/projects/")
    target = page.request.get(f"{api}results").json()["targets"][0]
    history = page.request.get(f"{api}results/{target}").json()
    east = [abs(value) if value is not None else 0.0 for value in history["p1_dx_m"]]
    return east.index(max(east))


@contextlib.contextmanager
def _served(workspace: Path) -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "app.cli", "serve", str(workspace), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().strip().rstrip("/")
        finally:
            server.send_signal(signal.SIGINT)


@contextlib.contextmanager
def _chromium() -> Iterator[Browser]:
    path = next((found for name in CHROMIUM_NAMES if (found := shutil.which(name))), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--enable-unsafe-swiftshader"])
        yield browser
        browser.close()


if __name__ == "__main__":
    sys.exit(main())
