"""From four files to the displacement CSV, on the shipped sample, as somebody does it who sees the program first."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from core.project import Project, read_project
from core.results import read_history_csv
from tests.browser.live import SAMPLE, ask, eventually, watched
from tests.browser.steps import (
    FRAME_SIZE,
    click_frame,
    click_ground,
    draw_bands,
    make_orthoimage,
    new_project,
    outline,
    pane,
    ready,
    saved,
    tell_height,
    to_step,
)

# How far a click misses what it aims at: a quarter of a pixel, which a person reaches with the loupe. It also falls on
# a whole pixel of the window, but at the zoom of these clicks that is a fiftieth of the picture's.
CLICK_PX = 0.25
PIXEL_CM = 2.0


def test_from_four_files_to_the_csv_that_the_headless_engine_writes(browser, server, headless):
    workspace, address = server
    folder, pages = workspace / "first-try", f"{address}/p/first-try"
    decided = read_project(SAMPLE)
    with watched(browser, address) as page:
        new_project(page, address, "first-try", "footage")
        tell_antenna(page, decided)
        make_orthoimage(page, pages, str(PIXEL_CM))
        place_all_pairs(page, pages, folder, decided)
        draw_regions_and_target(page, pages, decided)
        track(page)
        look_through(page, pages)
        tell_intervals(page, pages, decided)
        sweep_corners(page, pages)
        downloaded = download(page, pages, folder, headless)
    assert not folder.with_name("first-try-2").exists()
    made = read_project(folder)
    aimed = np.array([pair.frame_px for pair in decided.correspondences])
    missed = np.array([pair.frame_px for pair in made.correspondences]) - aimed
    assert len(missed) == 20
    assert 0.5 * CLICK_PX < missed.std() < 1.5 * CLICK_PX
    agree(downloaded, headless / "results" / "roof.csv", decided)


def tell_antenna(page: Page, decided: Project) -> None:
    """Say which columns the GPS file has and where on the roof its antenna stood."""
    page.get_by_role("button", name="Columns…").click()
    dialog = page.get_by_role("dialog")
    for label, column in (("Time, s", "time_s"), ("East, m", "east_m"), ("North, m", "north_m")):
        expect(dialog.get_by_label(label)).to_have_value(column)
    for label, metres in zip(("Antenna east", "Antenna north"), decided.inputs.gps.at_m, strict=True):
        dialog.get_by_label(label).fill(str(metres))
    dialog.get_by_role("button", name="Save").click()
    saved(page)


def place_all_pairs(page: Page, pages: str, folder: Path, decided: Project) -> None:
    """Click the sample's twenty pairs, each a little beside its place as hands do; four suffice for a ghost."""
    noise = np.random.default_rng(20)
    page.goto(f"{pages}/correspondences")
    ready(page, "Reference frame"), ready(page, "Orthoimage")
    grid = ask(pages, "orthoimage")["grid"]
    for placed, pair in enumerate(decided.correspondences, start=1):
        frame_px = np.array(pair.frame_px) + noise.normal(0, CLICK_PX, 2)
        ground_m = np.array(pair.ground_m) + noise.normal(0, CLICK_PX * grid["pixel_size_m"], 2)
        click_frame(page, frame_px)
        if placed == 5:
            a_ghost_does_not_count(page, folder)
        click_ground(page, grid, ground_m)
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(placed)
    expect(page.locator("#fit")).to_contain_text("RMS")
    saved(page)


def a_ghost_does_not_count(page: Page, folder: Path) -> None:
    """The counterpart proposed for a click in the frame outlives a reload, and is no pair until it is placed."""
    ghost = page.locator("[data-id='ghost-5']")
    expect(ghost).to_have_count(1)
    page.reload()
    ready(page, "Reference frame"), ready(page, "Orthoimage")
    expect(ghost).to_have_count(1)
    expect(page.locator("#fit .figures > div").first).to_have_text("4pairs")
    assert len(read_project(folder).correspondences) == 4


def draw_regions_and_target(page: Page, pages: str, decided: Project) -> None:
    to_step(page, "Regions")
    ready(page, "Reference frame"), ready(page, "Orthorectified")
    frame = pane(page, "Reference frame")
    # The sample's first region lies within the third, all but a few pixels: one outline does for both.
    for drawn, region in enumerate(decided.moving_regions_px[:0:-1], start=1):
        outline(page, frame, FRAME_SIZE, [np.array(corner) for corner in region])
        expect(page.locator("#moving .badge")).to_have_count(drawn)
    (target,) = decided.targets
    draw_bands(page, ask(pages, "rectified")["grid"], target.lines)
    tell_height(page, target.height_m, target.p1_p2_m)


def track(page: Page) -> None:
    to_step(page, "Track")
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.locator(".figures .name", has_text="frames/s")).to_be_visible(timeout=60_000)
    expect(page.get_by_role("link", name="Review the result")).to_be_visible(timeout=240_000)


def look_through(page: Page, pages: str) -> None:
    """Step through a few frames of the shaking: each shows what the engine measured on it."""
    page.get_by_role("link", name="Review the result").click()
    page.wait_for_selector(".review-frame[data-frame='0']")
    page.goto(f"{pages}/review?frame=339")
    for frame in (339, 340, 341):
        page.wait_for_selector(f".review-frame[data-frame='{frame}'] [data-id='roof/p1']")
        page.keyboard.press(".")
    expect(page.get_by_text("0 lost")).to_be_visible()


def tell_intervals(page: Page, pages: str, decided: Project) -> None:
    """Drag the pre-event across the plot, type the others; the engine solves again after each."""
    to_step(page, "Drift")
    expect(page.locator(".drift-main .plot-legend")).to_contain_text("Raw")
    area = page.locator(".drift-main .u-over").bounding_box()
    duration_s = ask(pages, "results/roof")["time_s"][-1]
    start, end = (area["x"] + area["width"] * at / duration_s for at in decided.intervals_s.pre_event)
    page.mouse.move(start, area["y"] + 60)
    page.mouse.down()
    page.mouse.move((start + end) / 2, area["y"] + 60)
    page.mouse.move(end, area["y"] + 60)
    page.mouse.up()
    for name in ("event", "residual"):
        for label, value in zip(("from", "to"), getattr(decided.intervals_s, name), strict=True):
            page.get_by_label(f"{name.capitalize()} {label}, s", exact=True).fill(str(value))
            page.keyboard.press("Enter")
    saved(page)
    eventually(lambda: not ask(pages, "results")["stale"], seconds=90)


def sweep_corners(page: Page, pages: str) -> None:
    """Take the knee of the sweep as corner frequency: for the preview, no filter is applied."""
    expect(page.get_by_text("Take the knee")).to_be_visible(timeout=60_000)
    page.keyboard.press("k")
    saved(page)
    eventually(lambda: not ask(pages, "results")["stale"], seconds=90)


def download(page: Page, pages: str, folder: Path, headless: Path) -> Path:
    """Compare with GPS, then take the CSV by the page's own link."""
    to_step(page, "Export")
    row = page.locator(".comparison tbody tr").first
    expect(row).to_contain_text("East")
    expected = json.loads((headless / "results" / "summary.json").read_text())["targets"]["roof"]["gps"]
    cells = [cell.replace("−", "-").split(" ")[0] for cell in row.locator("td").all_inner_texts()]
    for at, quantity in enumerate(("peak_positive_m", "peak_negative_m", "residual_m")):
        told = expected[quantity]["x"]
        assert [float(cell) / 100 for cell in cells[3 * at : 3 * at + 2]] == pytest.approx(
            [told["video"], told["gps"]], abs=5e-4
        )
    with page.expect_download() as given:
        page.locator("a[data-main]").click()
    file = folder.with_suffix(".csv")
    given.value.save_as(file)
    return file


def agree(browser_csv: Path, headless_csv: Path, decided: Project) -> None:
    """Both histories are the same within what clicks and the reading of lines leave open.

    Twenty clicks in the frame and twenty on the ground, each off by `CLICK_PX`, leave the ground's scale and turn
    uncertain by that over the pairs' spread and the root of their number: 1.5 in 10,000. What it does to a
    displacement is that share of how far the roof seems to move, parallax included: 0.05 mm, a thousandth of the 43 mm
    that a pixel of this video spans on the ground. Bands drawn by hand begin a little elsewhere along the roof's
    lines, so that part of each frame's random error, which the engine tells as sigma, is another one.
    """
    clicked, straight = read_history_csv(browser_csv), read_history_csv(headless_csv)
    assert len(clicked.frame) == len(straight.frame)
    assert np.mean(clicked.status == straight.status) > 0.98  # a frame on the verge of weak may fall to either side
    both = (clicked.status == "ok") & (straight.status == "ok")
    places = np.array([pair.frame_px for pair in decided.correspondences])
    spread_px = np.sqrt(places.var(axis=0).sum())
    share = np.sqrt(2) * CLICK_PX / (np.sqrt(len(places)) * spread_px)
    click_m = share * np.nanmax(np.abs(straight.p1_raw_m))
    start, end = decided.intervals_s.residual
    at_rest = both & (straight.time_s >= start) & (straight.time_s <= end)
    for name in ("p1", "p2"):
        apart = getattr(clicked, f"{name}_m") - getattr(straight, f"{name}_m")
        sigma = np.median(getattr(straight, f"{name}_sigma_m")[both], axis=0)
        assert (np.sqrt((apart[both] ** 2).mean(axis=0)) < np.hypot(click_m, sigma)).all()
        averaged = sigma / np.sqrt(at_rest.sum())
        assert (np.abs(apart[at_rest].mean(axis=0)) < 3 * np.hypot(click_m, averaged)).all()
