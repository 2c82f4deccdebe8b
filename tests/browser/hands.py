"""What a person's hand does in an image pane: zoom to a place with the wheel, click it, drag it; and where it is."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from playwright.sync_api import Locator, Page, expect

from core.coordinates import Floats

# The pane's own figures: factor exp(0.0016 * wheel), image px centres at +0.5 (see static/js).
_WHEEL_SPEED = 0.0016


@dataclass(frozen=True)
class Placement:
    """How a picture lies in a window: `window = scale * (image + 0.5) + corner`, CSS px."""

    scale: float
    corner: Floats

    def window(self, image: Floats) -> Floats:
        """Return where (..., 2) image px lie in the window."""
        placed: Floats = self.scale * (np.asarray(image, dtype=np.float64) + 0.5) + self.corner
        return placed

    def image(self, window: Floats) -> Floats:
        """Return which image px lie at (..., 2) window px."""
        found: Floats = (np.asarray(window, dtype=np.float64) - self.corner) / self.scale - 0.5
        return found


def fitted(page: Page, pane: Locator, size: tuple[int, int]) -> Placement:
    """Show the whole picture of (width, height) and return how it lies then."""
    pane.focus()
    page.keyboard.press("0")
    box = pane.bounding_box()
    assert box is not None
    scale = min(box["width"] / size[0], box["height"] / size[1])
    drawn(page, pane, scale)
    middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
    return Placement(scale, middle - scale * np.array(size) / 2)


def zoomed(page: Page, pane: Locator, size: tuple[int, int], image: Floats, wheel: float = 2000.0) -> Placement:
    """Turn the wheel over a place of the picture, as a person does before a careful click."""
    before = fitted(page, pane, size)
    pointer = np.round(before.window(image))
    page.mouse.move(*pointer)
    ratio = page.evaluate("devicePixelRatio")  # Chromium takes the wheel's way in device px
    page.mouse.wheel(0, -wheel * ratio)
    scale = before.scale * np.exp(_WHEEL_SPEED * wheel)
    drawn(page, pane, scale)
    return Placement(scale, pointer - scale * (before.image(pointer) + 0.5))


def drawn(page: Page, pane: Locator, scale: float) -> None:
    """Wait until a pane says that it shows its picture at a scale, and has drawn it so."""
    percent = int(100 * scale)  # told rounded, up or down
    expect(pane.locator(".pane-readout")).to_contain_text(re.compile(rf"(?<!\d)({percent}|{percent + 1})(\.\d)? %"))
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def click_at(page: Page, pane: Locator, size: tuple[int, int], image: Floats) -> None:
    """Zoom to a place and click it, to a fraction of a pixel."""
    page.mouse.click(*np.round(zoomed(page, pane, size, image).window(image)))


def centre_of(mark: Locator) -> Floats:
    """Return where the middle of an SVG mark is in the window, CSS px, from its own transform."""
    where = mark.evaluate("g => { const m = g.getScreenCTM(); return [m.e, m.f]; }")
    return np.array(where)


def finger(page: Page, start: Floats, shift: tuple[float, float]) -> None:
    """Put one finger somewhere in the window, drag it, let go."""
    touch = page.context.new_cdp_session(page)
    for kind, part in (("touchStart", 0.0), *(("touchMove", part / 10) for part in range(1, 11))):
        x, y = np.asarray(start) + part * np.array(shift)
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": float(x), "y": float(y)}]})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    touch.detach()


def pinch(page: Page, pane: Locator, spread_px: tuple[float, float], shift: tuple[float, float] = (0.0, 0.0)) -> None:
    """Put two fingers side by side about the middle of something, so far apart, and spread or shift them; let go."""
    box = pane.bounding_box()
    assert box is not None
    middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
    fingers = page.context.new_cdp_session(page)

    def touch(kind: str, part: float) -> None:
        half = (spread_px[0] + part * (spread_px[1] - spread_px[0])) / 2
        places = [middle + part * np.array(shift) + np.array([side * half, 0.0]) for side in (-1, 1)]
        points = [{"x": float(x), "y": float(y), "id": number} for number, (x, y) in enumerate(places)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points if kind != "touchEnd" else []})

    touch("touchStart", 0.0)
    for part in np.linspace(0, 1, 11)[1:]:
        touch("touchMove", float(part))
    touch("touchEnd", 1.0)
    fingers.detach()
