"""The manual steps as a person takes them, in the order of the pages: files, orthoimage, pairs, regions, bands."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from core.coordinates import Floats
from core.lens import read_lens
from core.project import LINE_NAMES, Lines
from tests.browser.hands import click_at, fitted
from tests.browser.live import SAMPLE

FRAME_SIZE = read_lens(SAMPLE / "lens.yaml").image_size_px
FILES = {"video": "video.mp4", "cloud": "site.laz", "lens": "lens.yaml", "gps": "gps.csv"}
# Two clicks on one place within a third of a second are a double click.
NO_DOUBLE_CLICK_MS = 400


def saved(page: Page) -> None:
    """Wait until every edit is on the disk."""
    expect(page.locator(".save-state")).to_have_attribute("data-state", "saved")


def pixels(page: Page) -> np.ndarray:
    """Return what the window shows without marks and captions, grey, device px."""
    page.evaluate("document.querySelectorAll('.pane > *:not(canvas)').forEach(e => e.style.visibility = 'hidden')")
    picture = Image.open(BytesIO(page.screenshot())).convert("L")
    page.evaluate("document.querySelectorAll('.pane > *').forEach(e => e.style.visibility = '')")
    return np.asarray(picture, dtype=np.float32)


def to_step(page: Page, name: str) -> None:
    """Go to another step by the bar on top."""
    page.get_by_role("navigation", name="Steps").get_by_role("link", name=name).click()


def pane(page: Page, name: str) -> Locator:
    return page.get_by_role("application", name=re.compile(f"^{name}"))


def choose_lens(page: Page) -> Locator:
    """Open the dialog that chooses a lens on this computer; return the field for its path."""
    page.locator(".input-card[data-kind=lens]").get_by_role("button", name="Choose on this computer").click()
    return page.get_by_label("Path of a file or folder")


def ready(page: Page, name: str) -> None:
    """Wait until a pane shows its picture."""
    expect(pane(page, name)).to_have_attribute("data-picture", re.compile(r"\d+x\d+"), timeout=20_000)


def ortho_px(grid: Mapping[str, Any], ground_m: Floats | Sequence[float]) -> Floats:
    """Return which pixel of an orthoimage a place on the ground is: u east, v south, (0, 0) a pixel's centre."""
    g = grid["pixel_size_m"]
    return np.array([(ground_m[0] - grid["west_m"]) / g - 0.5, (grid["north_m"] - ground_m[1]) / g - 0.5])


def new_project(page: Page, address: str, name: str, folder: str, kinds: Sequence[str] = tuple(FILES)) -> None:
    """Make a project from files in a folder of the workspace, and wait until each is understood."""
    page.goto(address)
    page.get_by_role("button", name="New project").first.click()
    page.get_by_label("Name", exact=True).fill(name)
    for kind in kinds:
        page.locator(f".source-row[data-kind={kind}]").get_by_role("button").click()
        files = page.get_by_role("listbox", name="Files")
        if files.get_by_role("option", name=folder).count() or kind == kinds[0]:
            files.get_by_role("option", name=folder).click()
        files.get_by_role("option", name=FILES[kind]).dblclick()
    page.get_by_role("button", name="Create").dblclick()  # as people do; it is one project all the same
    page.wait_for_url(f"**/p/{name}/inputs")
    for kind in kinds:
        badge = page.locator(f".input-card[data-kind={kind}] .badge")
        expect(badge).to_have_text("understood", timeout=60_000)  # a cloud is read in a job


def make_orthoimage(page: Page, pages: str, pixel_cm: str) -> None:
    """Make the orthoimage with a pixel of so many centimetres; the page shows it then."""
    page.goto(f"{pages}/orthoimage?view=picture")
    page.get_by_label("Pixel on the ground").fill(pixel_cm)
    page.keyboard.press("Enter")
    saved(page)
    page.get_by_role("button", name="Make the orthoimage").click()
    expect(page.locator("#raster-state")).to_have_text("made", timeout=60_000)


def click_frame(page: Page, frame_px: Floats) -> None:
    """Click a place in the reference frame."""
    click_at(page, pane(page, "Reference frame"), FRAME_SIZE, frame_px)


def click_ground(page: Page, grid: Mapping[str, Any], ground_m: Floats) -> None:
    """Click a place on the orthoimage."""
    click_at(page, pane(page, "Orthoimage"), (grid["width"], grid["height"]), ortho_px(grid, ground_m))


def outline(page: Page, element: Locator, size: tuple[int, int], corners: Sequence[Floats]) -> None:
    """Draw a polygon by a click on each corner, px of a picture of (width, height)."""
    for corner in corners:
        page.mouse.click(*np.round(fitted(page, element, size).window(np.asarray(corner))))
        page.wait_for_timeout(NO_DOUBLE_CLICK_MS)
    page.keyboard.press("Enter")


def draw_bands(page: Page, grid: Mapping[str, Any], lines: Lines) -> None:
    """Draw L1, L2 and T1, each by its two ends and its half width, and wait until the engine has seen each."""
    plan, size = pane(page, "Orthorectified"), (grid["width"], grid["height"])
    for name in LINE_NAMES:
        band = getattr(lines, name)
        ends = np.array([band.from_m, band.to_m])
        along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        beside = ends.mean(axis=0) + np.array([-along[1], along[0]]) * band.width_m / 2
        for place in (*ends, beside):
            click_at(page, plan, size, ortho_px(grid, place))
        expect(page.locator(f".band-row[data-line={name}] .found")).to_contain_text("points")


def tell_height(page: Page, height_m: float, p1_p2_m: float) -> None:
    """Type how high the target lies, and how far P1 is from P2."""
    page.get_by_label("Height above ground").fill(str(height_m))
    page.get_by_label("P1–P2 distance").fill(str(p1_p2_m))
    page.keyboard.press("Enter")
    saved(page)
