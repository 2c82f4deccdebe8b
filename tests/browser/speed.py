"""How quick the interface is on this computer: printed, never asserted, since a busy computer would fail it.

`python -m tests.browser.speed PROJECT [--only fps]` serves a copy of a measured project (best one with a 4K video) and
measures in Chromium without a graphics card what a person waits for.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser

from core.run import run_project
from tests.browser.live import ask, chromium, free_port, serving, watched
from tests.browser.steps import ready, saved

WINDOW = {"width": 1440, "height": 900}
# Turns the wheel or drags once in each animation frame, and tells how far apart the frames were.
GESTURE = """async ([selector, kind]) => {
    const pane = document.querySelectorAll(selector)[0];
    const box = pane.getBoundingClientRect();
    const at = { clientX: box.left + box.width / 2, clientY: box.top + box.height / 2, bubbles: true, pointerId: 1 };
    const frame = () => new Promise((done) => requestAnimationFrame(done));
    pane.setPointerCapture = () => undefined;
    const times = [await frame()];
    if (kind === "pan") pane.dispatchEvent(new PointerEvent("pointerdown", at));
    for (let i = 1; i <= 120; i += 1) {
        const x = at.clientX + 200 * Math.sin(i / 12), y = at.clientY + 140 * Math.sin(i / 9);
        const turn = Math.sin(i / 20) > 0 ? -40 : 40;
        if (kind === "pan") pane.dispatchEvent(new PointerEvent("pointermove", { ...at, clientX: x, clientY: y }));
        else pane.dispatchEvent(new WheelEvent("wheel", { ...at, deltaY: turn, cancelable: true }));
        times.push(await frame());
    }
    if (kind === "pan") pane.dispatchEvent(new PointerEvent("pointerup", at));
    return times.slice(1).map((time, i) => time - times[i]);
}"""
# From a key or a click until an element says something else.
UNTIL_CHANGED = """([act, selector, wanted]) => new Promise((resolve) => {
    const element = document.querySelector(selector);
    const before = element.textContent;
    const start = performance.now();
    const done = () => (wanted === null ? element.textContent !== before : element.dataset.frame === wanted);
    const check = () => (done() ? resolve(performance.now() - start) : setTimeout(check, 1));
    document.body.dispatchEvent(new KeyboardEvent("keydown", { ...act, bubbles: true }));
    check();
})"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what was chosen, or everything."""
    parser = argparse.ArgumentParser(prog="python -m tests.browser.speed", description=__doc__)
    parser.add_argument("project", type=Path)
    parser.add_argument("--only", choices=sorted(MEASURES))
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as workspace:
        project = Path(workspace) / "measured"
        shutil.copytree(chosen.project, project)
        if not (project / "results" / "summary.json").exists():
            run_project(project)
        with serving(Path(workspace), free_port()) as address, chromium() as browser:
            for name, measure in MEASURES.items():
                if chosen.only in (None, name):
                    measure(browser, f"{address}/p/measured")
    return 0


def tell(what: str, times_ms: Sequence[float]) -> None:
    found = np.array(times_ms)
    print(f"{what:44} median {np.median(found):6.0f} ms   worst {found.max():6.0f} ms   of {len(found)}", flush=True)


def gestures(browser: Browser, pages: str) -> None:
    for ratio in (1, 2):
        for step, names in (("correspondences", ("Reference frame", "Orthoimage")), ("review", ("Frame",))):
            with watched(browser, pages, viewport=WINDOW, device_scale_factor=ratio) as page:
                page.goto(f"{pages}/{step}")
                for name in names:
                    ready(page, name)
                page.wait_for_timeout(2500)
                for kind in ("pan", "zoom"):
                    gaps = np.array(page.evaluate(GESTURE, [".pane", kind]))
                    rate, slow = 1000 / np.median(gaps), 1000 / np.percentile(gaps, 95)
                    print(
                        f"{step} {kind}, {ratio} device px: {rate:.0f} frames/s, 19 of 20 above {slow:.0f}", flush=True
                    )


def residuals(browser: Browser, pages: str) -> None:
    with watched(browser, pages, viewport=WINDOW) as page:
        page.goto(f"{pages}/correspondences?pair=3")
        ready(page, "Reference frame")
        page.wait_for_timeout(2500)
        page.get_by_role("application", name="Reference frame").focus()
        times = []
        for turn in range(12):
            page.evaluate("document.querySelector('.pane').focus()")
            key = {"key": "ArrowRight" if turn % 2 else "ArrowLeft", "shiftKey": True}
            times.append(page.evaluate(NUDGED, [key, "#fit .figures"]))
            saved(page)
            page.wait_for_timeout(300)
        tell("residuals after an edit", times)


NUDGED = """([key, selector]) => new Promise((resolve) => {
    const element = document.querySelector(selector);
    const start = performance.now();
    new MutationObserver((_, observer) => (observer.disconnect(), resolve(performance.now() - start))).observe(
        element, { childList: true, subtree: true, characterData: true });
    document.activeElement.dispatchEvent(new KeyboardEvent("keydown", { ...key, bubbles: true, cancelable: true }));
})"""


def stepping(browser: Browser, pages: str) -> None:
    with watched(browser, pages, viewport=WINDOW) as page:
        last = ask(pages, "results/roof")["frame"][-1]
        first = last // 3
        page.goto(f"{pages}/review?frame={first}")
        page.wait_for_selector(f".review-frame[data-frame='{first}']")
        page.wait_for_timeout(3000)

        def steps(key: str, frames: Sequence[int], pause_ms: int) -> list[float]:
            found = []
            for frame in frames:
                act = {"key": key.rpartition("+")[2], "shiftKey": key.startswith("Shift+")}
                found.append(page.evaluate(UNTIL_CHANGED, [act, ".review-frame", str(frame)]))
                page.wait_for_timeout(pause_ms)
            return found

        tell("review, next frame", steps(".", range(first + 1, first + 16), 250))
        tell("review, first step back", steps(",", [first + 14], 250))
        tell("review, further steps back", steps(",", range(first + 13, first - 10, -1), 250))
        times = []
        for share in (0.8, 0.2, 0.67, 0.05, 0.95):
            times.append(page.evaluate(JUMP, round(share * last)))
            page.wait_for_timeout(2500)
        tell("review, far jump, first picture", [early for early, _ in times])
        tell("review, far jump, every pixel", [whole for _, whole in times])


JUMP = """(frame) => new Promise((resolve) => {
    const element = document.querySelector(".review-frame");
    const scrubber = document.querySelector(".player-scrubber");
    const start = performance.now();
    let first = null;
    scrubber.value = String(frame);
    scrubber.dispatchEvent(new Event("input", { bubbles: true }));
    const check = () => {
        const shown = element.dataset.frame === String(frame);
        if (shown && first === null) first = performance.now() - start;
        if (shown && element.dataset.whole === "true") resolve([first, performance.now() - start]);
        else setTimeout(check, 1);
    };
    check();
})"""


def previews(browser: Browser, pages: str) -> None:
    target = ask(pages, "")["project"]["targets"][0]
    with watched(browser, pages, viewport=WINDOW) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Orthorectified")
        page.wait_for_timeout(3000)
        times = page.evaluate(
            """async ([url, target]) => {
                const times = [];
                for (let i = 0; i < 20; i += 1) {
                    target.lines.L1.from_m[1] += 0.002;
                    const start = performance.now();
                    await (await fetch(url, { method: "POST", body: JSON.stringify({ target }),
                        headers: { "Content-Type": "application/json", "X-Rooftrack": "1" } })).json();
                    times.push(performance.now() - start);
                }
                return times;
            }""",
            [f"{pages.replace('/p/', '/api/projects/')}/lines/preview", target],
        )
        tell("preview of lines, first", times[:1])
        tell("preview of lines, while dragging", times[1:])


MEASURES: dict[str, Callable[[Browser, str], None]] = {
    "fps": gestures,
    "residuals": residuals,
    "review": stepping,
    "preview": previews,
}

if __name__ == "__main__":
    raise SystemExit(main())
