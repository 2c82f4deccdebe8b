"""Projects, inputs, orthoimage, correspondences and regions as a person uses them, on the shipped sample."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.error import HTTPError

import cv2
import numpy as np
import pytest
from playwright.sync_api import APIResponse, Page, Route, expect

from core.lens import read_lens
from core.project import read_project
from tests.browser.hands import centre_of, fitted, zoomed
from tests.browser.live import (
    SAMPLE,
    answer_first,
    arrived,
    ask,
    ask_bytes,
    edit_elsewhere,
    eventually,
    hold_first,
    watched,
)
from tests.browser.steps import (
    FRAME_SIZE,
    choose_lens,
    draw_bands,
    make_orthoimage,
    ortho_px,
    outline,
    pane,
    pixels,
    ready,
    saved,
    tell_height,
    to_step,
)
from tests.small_project import write_interlaced_video

WITHIN_PX = 0.5
# A click falls on a whole CSS pixel, and the wheel has zoomed to six or more of them per pixel of the picture.
CLICK_PX = 0.15
# Grey levels: corners drawn on a plain surface scatter by less, the squares of a board by more.
BLANK_LEVELS = 35


@pytest.fixture(scope="module")
def truth():
    return read_project(SAMPLE)


@pytest.mark.parametrize("ratio", [1, 2])
def test_pixels_and_marks_lie_where_the_engine_says(browser, project, truth, ratio):
    _, pages = project
    frame = cv2.cvtColor(cv2.imdecode(np.frombuffer(ask_bytes(pages, "frames/0.jpg"), np.uint8), 1), cv2.COLOR_BGR2GRAY)
    with watched(browser, pages, device_scale_factor=ratio) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        element = pane(page, "Reference frame")
        place = np.array(truth.correspondences[4].frame_px)
        for wheel in (0.0, 1300.0):
            lies = zoomed(page, element, FRAME_SIZE, place, wheel) if wheel else fitted(page, element, FRAME_SIZE)
            page.wait_for_timeout(100)
            for pair in truth.correspondences:
                expected = lies.window(np.array(pair.frame_px))
                assert centre_of(page.locator(f"[data-id='pair-{pair.id}']")) == pytest.approx(expected, abs=0.05)
        box = element.bounding_box()
        left, top, width, height = (round(box[name] * ratio) for name in ("x", "y", "width", "height"))
        seen = pixels(page)[top : top + height, left : left + width]
        # Near by, the pane shows true pixels. warpAffine counts pixel centres, the window edges: half a pixel apart.
        per_px = lies.scale * ratio
        shift = per_px * 0.5 + lies.corner * ratio - [left, top] - 0.5
        matrix = np.array([[per_px, 0.0, shift[0]], [0.0, per_px, shift[1]]])
        expected = cv2.warpAffine(frame, matrix, (width, height), flags=cv2.INTER_NEAREST).astype(np.float32)
        moved, response = cv2.phaseCorrelate(expected, seen, cv2.createHanningWindow((width, height), cv2.CV_32F))
        assert response > 0.9
        assert np.hypot(*moved) / ratio < WITHIN_PX
        assert (
            page.evaluate("[...document.querySelectorAll('.pane > canvas')].map(c => c.width)")
            == [round(box["width"] * ratio)] * 2
        )


def test_numbers_of_pairs_that_lie_close_are_all_legible(browser, project):
    folder, pages = project
    file = folder / "project.json"
    known = json.loads(file.read_text())
    first, *others = known["correspondences"][:4]
    # In the whole picture some two of its pixels go to one of the window, and a number is a mark wide.
    for pair, beside in zip(others, [(30, 0), (0, 40), (30, 45)], strict=True):
        pair["frame_px"] = [first["frame_px"][axis] + beside[axis] for axis in (0, 1)]
    known["correspondences"] = [first, *others]
    file.write_text(json.dumps(known))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        fitted(page, pane(page, "Reference frame"), FRAME_SIZE)
        numbers = pane(page, "Reference frame").locator(".shapes .mark text")
        expect(numbers).to_have_count(4)
        boxes = [number.bounding_box() for number in numbers.all()]
        for one, other in itertools.combinations(boxes, 2):
            apart_x = max(one["x"], other["x"]) - min(one["x"] + one["width"], other["x"] + other["width"])
            apart_y = max(one["y"], other["y"]) - min(one["y"] + one["height"], other["y"] + other["height"])
            assert max(apart_x, apart_y) > -1


def test_an_edit_is_undone_after_a_reload(browser, project):
    folder, pages = project
    before = read_project(folder)
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences?pair=3")
        ready(page, "Reference frame")
        pane(page, "Reference frame").focus()
        for key in ("ArrowRight", "Shift+ArrowRight", "Alt+ArrowDown"):
            page.keyboard.press(key)
        saved(page)
        u, v = before.correspondences[2].frame_px
        assert read_project(folder).correspondences[2].frame_px == pytest.approx((u + 1.1, v + 0.02))
        page.keyboard.press("Delete")
        expect(page.locator("#pairs tbody tr[data-id='3']")).to_have_count(0)
        saved(page)
        page.reload()
        ready(page, "Reference frame")
        page.keyboard.press("Control+z")
        expect(page.locator("#pairs tbody tr[data-id='3']")).to_have_count(1)
        page.get_by_role("button", name="Undo: Nudge pair 3").click()
        expect(page.get_by_role("button", name="Redo: Nudge pair 3")).to_be_enabled()
    assert read_project(folder) == before


def test_a_second_tab_on_an_older_state_is_told_not_obeyed(browser, project):
    folder, pages = project
    with watched(browser, pages) as first, watched(browser, pages) as second:
        second.route("**/events", lambda route: route.abort())  # it does not hear of the other's edits
        first.goto(f"{pages}/correspondences"), second.goto(f"{pages}/correspondences")
        ready(second, "Reference frame")
        first.get_by_role("checkbox", name="Pair 2 counts").click()
        saved(first)
        second.get_by_role("checkbox", name="Pair 5 counts").click()
        expect(second.get_by_role("alert")).to_contain_text("another window has changed this project")
        assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [2]
        expect(second.get_by_role("checkbox", name="Pair 2 counts")).not_to_be_checked()
        expect(second.get_by_role("checkbox", name="Pair 5 counts")).to_be_checked()
        second.get_by_role("button", name="Do it again").click()
        expect(first.get_by_role("checkbox", name="Pair 5 counts")).not_to_be_checked()
    assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [2, 5]


def test_all_edits_that_waited_behind_a_conflict_are_done_again(browser, project):
    folder, pages = project
    with watched(browser, pages) as first, watched(browser, pages) as second:
        second.route("**/events", lambda route: route.abort())
        first.goto(f"{pages}/correspondences"), second.goto(f"{pages}/correspondences")
        ready(second, "Reference frame")
        first.get_by_role("checkbox", name="Pair 2 counts").click()
        saved(first)
        with first_answer_held(second, pages):
            for pair in (5, 6, 7):
                second.get_by_role("checkbox", name=f"Pair {pair} counts").click()
        expect(second.get_by_role("alert")).to_contain_text("“Switch pair 5 off” and 2 more edits were not saved")
        second.get_by_role("button", name="Do it again").click()
        expect(first.get_by_role("checkbox", name="Pair 7 counts")).not_to_be_checked()
    assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [2, 5, 6, 7]


def test_nudges_done_again_are_still_one_step_of_undo(browser, project):
    folder, pages = project
    before = read_project(folder).correspondences[2].frame_px
    with watched(browser, pages) as first, watched(browser, pages) as second:
        second.route("**/events", lambda route: route.abort())
        first.goto(f"{pages}/correspondences"), second.goto(f"{pages}/correspondences?pair=3")
        ready(second, "Reference frame")
        first.get_by_role("checkbox", name="Pair 2 counts").click()
        saved(first)
        pane(second, "Reference frame").focus()
        with first_answer_held(second, pages):
            for _ in range(3):
                second.keyboard.press("ArrowRight")
        second.get_by_role("button", name="Do it again").click()
        after = (pytest.approx(before[0] + 0.3), before[1])
        eventually(lambda: read_project(folder).correspondences[2].frame_px == after)
        second.get_by_role("button", name="Undo: Nudge pair 3").click()
        eventually(lambda: read_project(folder).correspondences[2].frame_px == before)


def test_edits_wait_in_the_window_for_a_server_that_does_not_answer(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        asked: list[str] = []
        page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.dismiss()))
        page.context.set_offline(True)
        for pair in (4, 5):
            page.get_by_role("checkbox", name=f"Pair {pair} counts").click()
        expect(page.get_by_text("The server does not answer – trying again; your edits wait here")).to_be_visible()
        expect(page.locator(".save-state")).to_have_text("Not saved yet")
        for pair in (4, 5):
            expect(page.get_by_role("checkbox", name=f"Pair {pair} counts")).not_to_be_checked()
        figures = page.locator("#fit .figures")
        expect(figures).to_contain_class("awaited")  # they are of the pairs before
        expect(figures).to_contain_text("18 / 20")
        arrow = pane(page, "Reference frame").locator(".shapes .residual").first
        expect(arrow).to_have_css("opacity", "0.4")
        to_step(page, "Regions")
        assert arrived(page, asked) == "beforeunload"
        page.context.set_offline(False)
        saved(page)
        expect(page.get_by_text("The server does not answer – trying again")).to_be_hidden()
        expect(figures).not_to_contain_class("awaited")
        expect(arrow).to_have_css("opacity", "1")
        expect(figures).to_contain_text("18 / 20")
    assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [4, 5]


def test_an_edit_whose_answer_is_lost_on_its_way_is_made_once(browser, project):
    folder, pages = project
    u, v = read_project(folder).correspondences[2].frame_px
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences?pair=3")
        ready(page, "Reference frame")
        pane(page, "Reference frame").focus()
        taken: list[APIResponse] = []
        reachable: list[bool] = []

        def lose_the_answer(route: Route) -> None:
            if reachable:
                return route.continue_()
            if not taken:
                taken.append(route.fetch())
            route.abort()

        page.route(of_project(pages), lose_the_answer)
        page.keyboard.press("ArrowRight")
        expect(page.locator(".save-state")).to_have_attribute("data-state", "waiting")
        assert taken[0].ok
        reachable.append(True)
        saved(page)
        expect(page.get_by_role("alert")).to_have_count(0)
    assert read_project(folder).correspondences[2].frame_px == (pytest.approx(u + 0.1), v)


def test_a_wrong_edit_takes_none_behind_it_along(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        held = hold_first(page, of_project(pages))
        for pair in (5, 6):
            page.get_by_role("checkbox", name=f"Pair {pair} counts").click()
        arrived(page, held).fulfill(status=422, json={"error": {"message": "Pair 5 is needed.", "kind": "input"}})
        expect(page.get_by_role("alert")).to_have_text("“Switch pair 5 off” was not saved. Pair 5 is needed.")
        expect(page.get_by_role("checkbox", name="Pair 5 counts")).to_be_checked()
        saved(page)
    assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [6]


def test_a_tab_that_is_saving_misses_no_edit_of_another(browser, project):
    folder, pages = project
    with watched(browser, pages) as first, watched(browser, pages) as second:
        first.goto(f"{pages}/correspondences"), second.goto(f"{pages}/correspondences")
        ready(second, "Reference frame")
        with first_answer_held(second, pages):
            second.get_by_role("checkbox", name="Pair 5 counts").click()
            expect(first.get_by_role("checkbox", name="Pair 5 counts")).not_to_be_checked()
            first.get_by_role("checkbox", name="Pair 2 counts").click()
            saved(first)
            second.wait_for_timeout(2500)  # it is told of both edits, and of the changed file, before its own answer
        expect(second.get_by_role("checkbox", name="Pair 2 counts")).not_to_be_checked()
        second.get_by_role("checkbox", name="Pair 6 counts").click()  # no conflict: it stands on the newest state
        expect(first.get_by_role("checkbox", name="Pair 6 counts")).not_to_be_checked()
    assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [2, 5, 6]


def test_a_number_being_typed_is_not_overwritten_by_another_tab(browser, project):
    folder, pages = project
    with watched(browser, pages) as first, watched(browser, pages) as second:
        first.goto(f"{pages}/correspondences?pair=3"), second.goto(f"{pages}/correspondences?pair=3")
        ready(second, "Reference frame")
        typed = second.get_by_label("east", exact=True)
        typed.fill("2.5")
        for label, value in (("east", "1.25"), ("north", "-3.75")):
            first.get_by_label(label, exact=True).fill(value)
            first.keyboard.press("Enter")
        expect(second.get_by_label("north", exact=True)).to_have_value("-3.750")
        expect(typed).to_have_value("2.5")
        second.keyboard.press("Enter")
        saved(second)
    assert read_project(folder).correspondences[2].ground_m == (2.5, -3.75)


def test_a_page_is_not_left_unasked_before_its_edits_are_saved(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        asked: list[str] = []
        page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.dismiss()))
        with first_answer_held(page, pages):
            for pair in (5, 6):
                page.get_by_role("checkbox", name=f"Pair {pair} counts").click()
            to_step(page, "Regions")
            assert arrived(page, asked) == "beforeunload"
        saved(page)
        to_step(page, "Regions")
        page.wait_for_url("**/regions")
    assert [pair.id for pair in read_project(folder).correspondences if not pair.enabled] == [5, 6]
    assert len(asked) == 1


def of_project(pages: str) -> str:
    """Return where a project is asked for and saved, given the address of its pages."""
    return pages.replace("/p/", "/api/projects/")


@contextmanager
def first_answer_held(page: Page, pages: str) -> Iterator[None]:
    """Have the server take the next edit of a page at once, and the page hear of it only when this ends."""
    held: list[tuple[Route, APIResponse]] = []
    answer_first(page, of_project(pages), lambda route: held.append((route, route.fetch())))
    yield
    route, response = arrived(page, held)
    route.fulfill(response=response)


def test_clicks_on_the_undistorted_frame_are_stored_raw(browser, project):
    folder, pages = project
    lens = read_lens(SAMPLE / "lens.yaml")
    wanted = np.array(FRAME_SIZE) * [0.15, 0.85]
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.keyboard.press("u")
        expect(page.locator(".pane-chip", has_text="undistorted")).to_be_visible()
        mark = page.locator("[data-id='pair-1']").first
        lies = zoomed(page, pane(page, "Reference frame"), FRAME_SIZE, wanted)
        raw = np.array(read_project(folder).correspondences[0].frame_px)
        assert centre_of(mark) == pytest.approx(lies.window(lens.undistort(raw)), abs=WITHIN_PX)
        page.mouse.click(*np.round(lies.window(wanted)))
        expect(page.get_by_label("u", exact=True)).not_to_have_value("")
        stored = [float(page.get_by_label(name, exact=True).input_value()) for name in ("u", "v")]

        def no_image(route: Route) -> None:
            if route.request.post_data_json["from"] == "und":
                route.fulfill(json={"points": [None]})
            else:
                route.continue_()

        page.route("**/transform", no_image)
        marks = page.locator("[data-id^='pair-']")
        expect(marks).to_have_count(21)
        page.mouse.click(*np.round(lies.window(wanted) + [60.0, 0.0]))
        expect(page.get_by_role("status").filter(has_text="the lens has no image of this place")).to_be_visible()
        expect(marks).to_have_count(21)
    assert np.array(stored) == pytest.approx(lens.distort(wanted), abs=CLICK_PX)


def test_a_picture_that_comes_late_takes_no_newer_ones_place(browser, project):
    _, pages = project
    whole = "x".join(str(size) for size in FRAME_SIZE)
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame"), ready(page, "Orthorectified")
        late = hold_first(page, "**/frames/1.jpg")
        edit_elsewhere(page, pages, reference_frame=1)
        answer = arrived(page, late)
        edit_elsewhere(page, pages, reference_frame=3)
        page.wait_for_timeout(1500)
        answer.fulfill(body=ask_bytes(pages, "frames/1.jpg?w=160"), content_type="image/jpeg")
        expect(page.locator(".pane-chip", has_text="Frame 3 · raw")).to_be_visible()
        page.wait_for_timeout(500)
        expect(pane(page, "Reference frame")).to_have_attribute("data-picture", whole)

        plan = pane(page, "Orthorectified")
        box = plan.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        place = plan.locator(".pane-readout").inner_text()
        late = hold_first(page, "**/rectified.jpg*")
        edit_elsewhere(page, pages, orthoimage=ask(pages, "")["project"]["orthoimage"] | {"pixel_size_m": 0.07})
        answer = arrived(page, late)
        page.mouse.move(box["x"] + box["width"] / 2 + 1, box["y"] + box["height"] / 2)
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.wait_for_timeout(200)
        assert plan.locator(".pane-readout").inner_text() == place  # the raster belongs to the picture
        answer.continue_()
        ready(page, "Orthorectified")


def test_points_go_to_qgis_and_come_back(browser, project, tmp_path):
    folder, pages = project
    before = read_project(folder).correspondences
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.get_by_role("button", name="Import and export").click()
        with page.expect_download() as download:
            page.get_by_role("menuitem", name="Export").click()
        file = tmp_path / "clicks.points"
        download.value.save_as(file)
        first = file.read_text().splitlines()[1].split(",")
        u, v = before[0].frame_px
        assert [float(cell) for cell in first[:5]] == pytest.approx([*before[0].ground_m, u + 0.5, -(v + 0.5), 1])
        import_points(page, file)
        expect(
            page.get_by_role("status").filter(has_text="All 20 pairs of clicks.points are here already")
        ).to_be_visible()
        lines = file.read_text().splitlines()
        east, rest = lines[-1].split(",", 1)
        file.write_text("\n".join([*lines[:-1], f"{float(east) + 1},{rest}"]) + "\n")  # one of them elsewhere
        import_points(page, file)
        page.get_by_role("dialog").get_by_role("button", name="Add 1 pair").click()
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(21)
        file.write_text("\n".join(lines[:10]) + "\n")
        page.get_by_role("button", name="Import and export").click()
        page.get_by_role("menuitem", name="Delete all pairs").click()
        import_points(page, file)
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(9)
        file.write_text("\n".join(lines) + "\n")
        import_points(page, file)
        expect(page.get_by_role("dialog")).to_contain_text("9 of them are here already")
        page.get_by_role("dialog").get_by_role("button", name="Replace the 9 pairs here").click()
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(20)
        saved(page)
    after = read_project(folder).correspondences
    assert np.array([pair.frame_px for pair in after]) == pytest.approx(np.array([pair.frame_px for pair in before]))


def import_points(page: Page, file) -> None:
    """Choose a file of pairs from the menu."""
    page.get_by_role("button", name="Import and export").click()
    with page.expect_file_chooser() as chooser:
        page.get_by_role("menuitem", name="Import").click()
    chooser.value.set_files(file)


def test_regions_and_bands_are_drawn_and_previewed_as_the_engine_sees_them(browser, project, truth):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    target, regions = document["targets"][0], document["moving_regions_px"]
    (folder / "project.json").write_text(json.dumps(document | {"targets": [], "moving_regions_px": []}))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame"), ready(page, "Orthorectified")
        frame, plan = pane(page, "Reference frame"), pane(page, "Orthorectified")
        outline(page, frame, FRAME_SIZE, [regions[0][i] for i in (0, 1, 3, 4)])
        expect(page.locator("#moving .badge")).to_have_text("4 corners")
        grid = ask(pages, "rectified")["grid"]
        size = (grid["width"], grid["height"])
        draw_bands(page, grid, truth.targets[0].lines)
        expect(page.locator("#targets li[data-target=roof]")).to_be_visible()
        tell_height(page, target["height_m"], target["p1_p2_m"])
        made = read_project(folder).targets[0]
        for line in ("L1", "L2", "T1"):
            drawn, given = getattr(made.lines, line), target["lines"][line]
            assert [*drawn.from_m, *drawn.to_m] == pytest.approx([*given["from_m"], *given["to_m"]], abs=0.01)
            assert drawn.width_m == pytest.approx(given["width_m"], abs=0.02)

        seen = preview(page, pages, made)
        for name in ("p1", "p2"):
            raw = fitted(page, frame, FRAME_SIZE).window(np.array(seen[name]["raw"]))
            mark = page.locator(f"#frame [data-id='found:{name}']")
            expect(mark).to_have_count(1)
            assert centre_of(mark) == pytest.approx(raw, abs=WITHIN_PX)
            flat = fitted(page, plan, size).window(ortho_px(grid, seen[name]["plan"]))
            assert centre_of(page.locator(f"#plan [data-id='found:{name}']")) == pytest.approx(flat, abs=WITHIN_PX)

        inside = np.array(made.lines.L1.from_m) * 0.8 + np.array(made.lines.L1.to_m) * 0.2
        drag(page, plan, size, grid, inside, [0.0, 0.5])
        saved(page)
        moved = read_project(folder).targets[0].lines.L1
        assert np.array(moved.from_m) - made.lines.L1.from_m == pytest.approx([0.0, 0.5], abs=0.03)
        page.keyboard.press("Shift+ArrowUp")
        page.keyboard.press("]")
        saved(page)
        nudged = read_project(folder).targets[0].lines.L1
        assert nudged.from_m[1] - moved.from_m[1] == pytest.approx(grid["pixel_size_m"], abs=2e-4)
        assert nudged.width_m - moved.width_m == pytest.approx(0.02)
        drag(page, plan, size, grid, np.array(nudged.to_m), [0.4, 0.1])
        saved(page)
        turned = read_project(folder).targets[0].lines.L1
        assert (turned.from_m, turned.width_m) == (nudged.from_m, nudged.width_m)
        assert np.array(turned.to_m) - nudged.to_m == pytest.approx([0.4, 0.1], abs=0.01)


def preview(page: Page, pages: str, target) -> dict:
    address = pages.replace("/p/", "/api/projects/")
    headers = {"X-Rooftrack": "1", "Origin": pages.split("/p/")[0]}
    body = {"target": target.model_dump(mode="json")}
    return page.request.post(f"{address}/lines/preview", data=body, headers=headers).json()


def drag(page: Page, plan, size, grid, place, by) -> None:
    """Drag what lies at a place of the plan, metres: a band by its inside, or one of its handles."""
    lies = zoomed(page, plan, size, ortho_px(grid, place), 900.0)
    page.mouse.move(*lies.window(ortho_px(grid, place)))
    page.mouse.down()
    for share in (0.5, 1.0):
        page.mouse.move(*lies.window(ortho_px(grid, place + share * np.array(by))))
    page.mouse.up()


def test_a_target_is_measured_relative_to_another(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    (roof,) = document["targets"]
    table = roof | {"name": "table", "height_m": 1.2}
    (folder / "project.json").write_text(json.dumps(document | {"targets": [roof, table]}))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions?target=roof")
        relative = page.get_by_label("Displacement relative to")
        expect(relative.locator("option")).to_have_text(["its own rest position", "table"])
        relative.select_option("table")
        saved(page)
        assert [target.relative_to for target in read_project(folder).targets] == ["table", None]
        page.locator("#targets li[data-target=table]").click()
        expect(relative.locator("option")).to_have_text(["its own rest position"])  # neither itself nor in a circle
        page.reload()
        page.locator("#targets li[data-target=roof]").click()
        expect(relative).to_have_value("table")
        page.get_by_role("button", name="Actions for table").click()
        page.get_by_role("menuitem", name="Delete").click()
        saved(page)
        assert [(target.name, target.relative_to) for target in read_project(folder).targets] == [("roof", None)]
        page.get_by_role("button", name="Add target").click()
        page.get_by_role("menuitem", name="Three lines").click()
        relative.select_option("roof")  # of a target still being drawn
        act(page, page.locator("#targets li[data-target=roof]"), "Rename…", name="top")
        page.locator("#targets li[data-target=table]").click()
        expect(relative).to_have_value("top")
        act(page, page.locator("#targets li[data-target=top]"), "Delete")
        page.locator("#targets li[data-target=table]").click()
        expect(relative).to_have_value("")
        saved(page)


def test_the_columns_of_another_gps_file_are_told(browser, project):
    folder, pages = project
    rows = (SAMPLE / "gps.csv").read_text().splitlines()
    (folder / "rover.csv").write_text("\n".join(["seconds,E,N", *rows[1:]]) + "\n")
    document = json.loads((folder / "project.json").read_text())
    document["inputs"]["gps"] = {"file": "rover.csv"}
    (folder / "project.json").write_text(json.dumps(document))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        card = page.locator(".input-card[data-kind=gps]")
        expect(card.locator(".note.bad")).to_contain_text("time_s")
        card.get_by_role("button", name="Columns…").click()
        dialog = page.get_by_role("dialog")
        for label, column in (("Time, s", "seconds"), ("East, m", "E"), ("North, m", "N")):
            dialog.get_by_label(label).select_option(column)
        dialog.get_by_label("Antenna east").fill("0.5")
        dialog.get_by_label("Antenna north").fill("-1.25")
        dialog.get_by_role("button", name="Save").click()
        expect(card.locator(".badge")).to_have_text("understood")
        expect(card).to_contain_text(f"{len(rows) - 1}")
    gps = read_project(folder).inputs.gps
    assert (gps.time, gps.x, gps.y, gps.at_m) == ("seconds", "E", "N", (0.5, -1.25))


def test_a_pair_is_placed_by_the_keyboard_alone(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        pane(page, "Reference frame").focus()
        page.keyboard.press("Escape")
        page.keyboard.press("1")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
        expect(page.locator("#selection")).to_contain_text("Pair 21, unfinished")
        for name, value in (("east", "1.5"), ("north", "-2.25")):
            page.get_by_label(name, exact=True).fill(value)
            page.keyboard.press("Enter")
        expect(page.locator("#pairs tbody tr[data-id='21']")).to_have_count(1)
        page.keyboard.press("Escape")
        page.locator("body").press("?")
        expect(page.get_by_role("dialog")).to_contain_text("Nudge the selected mark by 0.02 px")
        saved(page)
    assert read_project(folder).correspondences[20].ground_m == (1.5, -2.25)


TOLD = """async (message) => {
    const { words, step } = (await import("/static/js/lib/problems.js")).told(message);
    return [words, step];
}"""


def test_the_engines_sentences_are_told_in_words_of_the_pages(browser, project):
    _, pages = project
    sentences = {
        "/a folder/p/project.json: inputs.lens: missing, but needed; calibrate with rooftrack lens.": (
            "Lens: missing, but needed; calibrate it.",
            "inputs",
        ),
        "project.json: targets.roof.lines.T1 holds no line; draw the band along a strip.": (
            "Band T1 holds no line; draw the band along a strip.",
            "regions",
        ),
        "project.json: targets[0].lines.L1.from_m: [1, 2] lies outside orthoimage.extent_m; move it.": (
            "Band L1: [1, 2] lies outside the orthoimage's extent; move it.",
            "regions",
        ),
        "project.json: correspondences: id 3: frame_px [1, 2] is outside the 3 x 4 frame; click it again.": (
            "Correspondences: pair 3: [1, 2] is outside the 3 x 4 frame; click it again.",
            "correspondences",
        ),
        "correspondence 5 lies where the lens model ends; move or disable it.": (
            "Pair 5 lies where the lens model ends; move or disable it.",
            "correspondences",
        ),
        "no correspondence is enabled, at least four are needed.": (
            "No correspondence is in use yet, at least four are needed.",
            "correspondences",
        ),
        "/w/p/gps.csv: is empty; export it again.": ("gps.csv: is empty; export it again.", None),
        "Measured 20 frames/s and 3 m/s.": ("Measured 20 frames/s and 3 m/s.", None),
        "/etc/x: lies outside the folders Rooftrack may read (/home/x).": (
            "/etc/x: lies outside the folders Rooftrack may read (/home/x).",
            None,
        ),
    }
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        for sentence, (words, step) in sentences.items():
            assert page.evaluate(TOLD, sentence) == [words, step]


def test_a_problem_leads_to_the_step_where_it_is_put_right(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    document["targets"] = []
    (folder / "project.json").write_text(json.dumps(document))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/track")
        problem = page.locator(".note.bad")
        expect(problem).to_contain_text("Targets: none")
        expect(problem).not_to_contain_text("project.json")
        problem.get_by_role("link", name="Regions").click()
        page.wait_for_url("**/regions")


def test_what_to_know_of_a_file_stands_on_its_card(browser, project):
    folder, pages = project
    write_interlaced_video(folder / "fields.mp4")
    far = np.array([500_000.0, 5_000_000.0, 100.0])
    corners = np.array([[x, y, 0] for x in range(20) for y in range(20)])
    rows = (far + corners).astype("<f4").tobytes()
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n"
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    (folder / "coarse.ply").write_bytes(f"{header}{properties}end_header\n".encode() + rows)
    document = json.loads((folder / "project.json").read_text())
    document["inputs"] = {"video": "fields.mp4", "cloud": "coarse.ply"}
    (folder / "project.json").write_text(json.dumps(document))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        warning = page.locator(".input-card[data-kind=video] .note.warn")
        expect(warning).to_contain_text("fields.mp4: says that it is interlaced")
        picture = page.get_by_alt_text("First frame").bounding_box()
        assert warning.bounding_box()["y"] >= picture["y"] + picture["height"]
        told = page.locator(".input-card[data-kind=cloud] .note.info")
        expect(told).to_contain_text(re.compile("^coarse.ply: coordinates are stored in single precision"))


def test_a_narrow_window_reads_downwards(browser, project):
    _, pages = project
    with watched(browser, pages, viewport={"width": 800, "height": 900}) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        stage, side = page.locator(".stage").bounding_box(), page.locator(".side").bounding_box()
        assert (stage["width"], side["x"], side["width"]) == (800, 0, 800)
        assert side["y"] >= stage["y"] + stage["height"]
        expect(page.locator(".brand-name")).to_be_hidden()
        assert page.evaluate("document.documentElement.scrollWidth") == 800
        page.set_viewport_size({"width": 480, "height": 800})
        page.goto(f"{pages}/export")
        expect(page.locator("[data-step=export] .name")).to_be_in_viewport(ratio=1)
        page.set_viewport_size({"width": 1920, "height": 1080})
        page.goto(f"{pages}/inputs")
        assert page.locator(".card-grid").bounding_box()["width"] > 1400


def test_regions_are_numbered_and_surrounded_alike(browser, project, truth):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Orthorectified")
        numbers = [page.locator(f"[data-id='moving:number:{i}'] text") for i in range(len(truth.moving_regions_px))]
        assert [number.text_content() for number in numbers] == [str(i + 1) for i in range(len(numbers))]
        surround = page.evaluate("getComputedStyle(document.querySelector('.pane')).backgroundColor")
    levels = [int(level) for level in re.findall(r"\d+", surround)]
    outside = "".join(f"{level:02x}" for level in levels)
    picture = cv2.imdecode(np.frombuffer(ask_bytes(pages, f"rectified.jpg?outside={outside}"), np.uint8), 1)
    assert picture[0, 0, ::-1] == pytest.approx(levels, abs=4)  # JPEG
    with pytest.raises(HTTPError, match="422"):
        ask_bytes(pages, "rectified.jpg?outside=red")


def test_a_file_is_chosen_by_typing_its_path(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        lens = page.locator(".input-card[data-kind=lens]")
        (folder / "again.yaml").write_text((SAMPLE / "lens.yaml").read_text())
        path = choose_lens(page)
        expect(path).to_have_value(re.compile("^/"))
        path.fill(str(folder / "none.yaml"))
        path.press("Enter")
        expect(page.get_by_role("dialog")).to_contain_text("no such file")
        (folder / "wrong.yaml").write_text("not a lens")
        path.fill(str(folder / "wrong.yaml"))
        path.press("Enter")
        expect(lens.locator(".refusal")).to_contain_text("wrong.yaml")
        choose_lens(page)
        path.fill(str(folder))
        path.press("Enter")
        expect(page.get_by_role("option", name="again.yaml")).to_be_visible()
        path.fill(f'"{folder / "again.yaml"}"')
        path.press("Enter")
        expect(page.get_by_role("dialog")).to_have_count(0)
        saved(page)
        eventually(lambda: read_project(folder).inputs.lens == "again.yaml")
        expect(lens.locator(".refusal")).to_be_empty()


def test_what_is_missing_is_named_with_the_way_to_it(browser, project, server):
    _, pages = project
    _, address = server
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")  # a video, but no cloud
        ready(page, "Reference frame")
        ortho = pane(page, "Orthoimage")
        expect(ortho.get_by_role("link", name="Choose a point cloud")).to_be_visible()
        expect(ortho.get_by_role("link", name="Make the orthoimage")).to_have_count(0)
        ortho.click(position={"x": 60, "y": 300})
        expect(ortho.locator(".pane-note")).to_have_attribute("data-clicks", "1")
        expect(page.get_by_text("Nothing was placed.")).to_be_attached()
        page.goto(f"{pages}/orthoimage")
        expect(page.get_by_role("button", name="Make the orthoimage")).to_be_disabled()
        page.get_by_label("west", exact=True).fill("-5")
        page.keyboard.press("Enter")
        expect(page.locator("#raster .hint")).to_have_text(
            "Give south, east and north too: until then, the extent stays as it was."
        )
        # What is typed so far outlasts any other change.
        page.get_by_label("Ground level in the cloud").fill("0.5")
        page.keyboard.press("Enter")
        expect(page.get_by_role("button", name="Undo")).to_be_enabled()
        expect(page.get_by_label("west", exact=True)).to_have_value("-5.00")
        made = page.request.post(
            f"{address}/api/projects", data={"name": "bare"}, headers={"X-Rooftrack": "1", "Origin": address}
        ).json()["id"]
        page.goto(f"{address}/p/{made}/regions")
        expect(page.get_by_text("Click the corners in the left picture")).to_be_visible()
        plan = pane(page, "Orthorectified")
        expect(plan.get_by_role("link", name="Place correspondences")).to_have_count(0)
        plan.get_by_role("link", name="Inputs").click()
        page.wait_for_url("**/inputs")


def test_inputs_are_sent_taken_back_and_calibrated(browser, project, tmp_path):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        lens = page.locator(".input-card[data-kind=lens]")
        expect(lens.locator(".badge")).to_have_text("understood")
        lens.get_by_role("button", name="Remove").click()
        expect(lens.locator(".badge")).to_have_text("not given")
        with page.expect_file_chooser() as chooser:
            lens.get_by_role("button", name="Upload…").click()
        chooser.value.set_files(SAMPLE / "lens.yaml")
        expect(lens.locator(".badge")).to_have_text("understood")
        assert read_project(folder).inputs.lens == "lens.yaml"
        with page.expect_file_chooser() as chooser:
            lens.get_by_role("button", name="Upload…").click()
        wrong = tmp_path / "wrong.yaml"
        wrong.write_text("not a lens")
        chooser.value.set_files(wrong)
        expect(page.get_by_role("alert")).to_contain_text("wrong.yaml")
        expect(lens.locator(".refusal")).to_contain_text("wrong.yaml")
        expect(lens.locator(".badge")).to_have_text("understood")  # the lens before stays
        lens.get_by_role("button", name="Dismiss").click()
        expect(lens.locator(".refusal")).to_be_empty()
        assert read_project(folder).inputs.lens == "lens.yaml"

        lens.get_by_role("button", name="Calibrate…").click()
        page.get_by_role("button", name="Pictures on this computer…").click()
        files = page.get_by_role("listbox", name="Files")
        files.get_by_role("option", name="footage").click()
        files.get_by_role("option", name="checkerboards").click()
        expect(files.get_by_role("option", name="board_01.jpg")).to_be_visible()
        for board in files.get_by_role("option").all():
            board.click()
        page.get_by_role("button", name=re.compile(r"Choose \d+ files")).click()
        page.get_by_label("Square").fill("0.04")
        page.get_by_role("button", name="Calibrate", exact=True).click()
        report = page.get_by_role("region", name="Calibration report")
        expect(report).to_contain_text("pictures used", timeout=60_000)
        board_is_shown(page, report)
        expect(lens.locator(".badge")).to_have_text("understood")
    assert read_lens(folder / read_project(folder).inputs.lens).focal_px[0] == pytest.approx(
        read_lens(SAMPLE / "lens.yaml").focal_px[0], rel=0.02
    )


def board_is_shown(page: Page, report) -> None:
    """The picture chosen by its path lies under the corners found in it: it is no plain surface."""
    board = report.get_by_role("application", name="Checkerboard picture")
    expect(board).to_have_attribute("data-picture", re.compile(r"\d+x\d+"))
    page.wait_for_timeout(500)
    shown = cv2.imdecode(np.frombuffer(board.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
    middle = shown[shown.shape[0] // 4 : -shown.shape[0] // 4, shown.shape[1] // 4 : -shown.shape[1] // 4]
    assert middle.std() > BLANK_LEVELS


def test_an_upload_that_is_cancelled_leaves_nothing(browser, project, tmp_path):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        video = page.locator(".input-card[data-kind=video]")
        expect(video.locator(".badge")).to_have_text("understood")
        line = page.context.new_cdp_session(page)
        slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 400_000}
        line.send("Network.emulateNetworkConditions", slow)
        large = tmp_path / "large.mp4"
        large.write_bytes(bytes(8_000_000))
        with page.expect_file_chooser() as chooser:
            video.get_by_role("button", name="Upload…").click()
        chooser.value.set_files(large)
        expect(video.locator(".job .numbers")).to_contain_text("MB/s")
        asked: list[str] = []
        page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.dismiss()))
        to_step(page, "Track")
        assert arrived(page, asked) == "beforeunload"
        video.get_by_role("button", name="Cancel").click()
        expect(video.locator(".job")).to_have_count(0)
        expect(video.locator(".badge")).to_have_text("understood")
        page.wait_for_timeout(300)
    assert not [file for file in folder.rglob("*") if "large" in file.name or file.name.endswith(".part")]
    assert read_project(folder).inputs.video == "../footage/video.mp4"


def test_a_clicked_height_and_a_region_make_a_target_of_points(browser, project, truth):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    inputs = document["inputs"] | {"cloud": "../footage/site.laz"}
    (folder / "project.json").write_text(json.dumps(document | {"inputs": inputs, "targets": []}))
    roof = document["targets"][0]["lines"]
    with watched(browser, pages) as page:
        make_orthoimage(page, pages, "4")
        ready(page, "Orthoimage")
        grid = ask(pages, "orthoimage")["grid"]
        place = np.array(truth.inputs.gps.at_m) + [1.5, 0.3]  # beside the antenna, on the roof
        pane_of_ground = pane(page, "Orthoimage")
        page.mouse.click(*fitted(page, pane_of_ground, (grid["width"], grid["height"])).window(ortho_px(grid, place)))
        expect(page.locator("#height .value").first).to_contain_text("18.")
        page.get_by_role("button", name="Take this height").click()
        saved(page)
        wall = {"xyz_m": [*place, 9.0], "height_m": 9.0, "spread_m": None, "points": 1}
        events = f"event: pick\ndata: {json.dumps(wall)}\n\n"  # a click into the 3D scene
        answer_first(page, "**/events", lambda route: route.fulfill(body=events, content_type="text/event-stream"))
        page.reload()
        expect(page.locator("#height .value")).to_have_text(["9.00 m", "–"])

        page.goto(f"{pages}/regions?layout=plan")
        ready(page, "Orthorectified")
        expect(page.locator("#targets li[data-target=roof]")).to_contain_text("drawing")
        page.get_by_role("button", name="Actions for roof").click()
        page.get_by_role("menuitem", name="Delete").click()
        page.get_by_role("button", name="Add target").click()
        page.get_by_role("menuitem", name="Textured region").click()
        grid = ask(pages, "rectified")["grid"]
        plan = pane(page, "Orthorectified")
        corners = [roof["L1"]["from_m"], roof["L1"]["to_m"], roof["L2"]["to_m"], roof["L2"]["from_m"]]
        outline(page, plan, (grid["width"], grid["height"]), [ortho_px(grid, corner) for corner in corners])
        page.get_by_label("Height above ground").fill("18.3")
        page.keyboard.press("Enter")
        saved(page)
    target = read_project(folder).targets[0]
    assert (target.kind, target.height_m, len(target.region_m)) == ("points", 18.3, 4)


def test_projects_are_copied_renamed_archived_restored_and_deleted_with_undo(browser, project, tmp_path):
    folder, pages = project
    address = pages.split("/p/")[0]
    with watched(browser, address) as page:
        page.goto(address)
        card = page.locator(f"[data-project='{folder.name}']")
        act(page, card, "Rename…", name="Sample by hand")
        expect(card.get_by_role("heading")).to_have_text("Sample by hand")
        expect(card.locator(".folder")).to_have_text(f"in folder {folder.name}")
        act(page, card, "Duplicate…", name="A copy of it")
        expect(page.get_by_role("heading", name="A copy of it")).to_be_visible()
        with page.expect_download() as download:
            act(page, card, "Archive without inputs")
        archive = tmp_path / "sample.zip"
        download.value.save_as(archive)
        act(page, card, "Delete")
        expect(card).to_have_count(0)
        assert not folder.exists()
        page.get_by_role("button", name="Undo", exact=True).click()
        expect(card).to_have_count(1)
        expect(page.get_by_role("button", name="Deleted projects")).to_have_count(0)
        act(page, card, "Delete")
        page.reload()  # and nothing is left to undo it
        page.get_by_role("button", name="Deleted projects (1)").click()
        expect(page.get_by_role("dialog")).to_contain_text(f"in folder {folder.name} · deleted just now · kept until")
        page.get_by_role("button", name="Restore Sample by hand").click()
        expect(page.locator(".toast")).to_contain_text("Sample by hand was restored.")
        expect(card).to_have_count(1)
        expect(page.get_by_role("button", name="Deleted projects")).to_have_count(0)
        before = page.locator("[data-project]").count()
        with page.expect_file_chooser() as chooser:
            page.get_by_role("button", name="Restore archive…").click()
        chooser.value.set_files(archive)
        expect(page.locator("[data-project]")).to_have_count(before + 1)
        page.locator(".toast").get_by_role("button", name="Open").last.click()
        expect(page.locator(".project-name")).to_have_text("Sample by hand")
    assert read_project(folder).name == "Sample by hand"


def test_deleted_projects_that_cannot_be_asked_for_are_asked_for_again(browser, project):
    folder, pages = project
    address = pages.split("/p/")[0]
    with watched(browser, address) as page:
        page.goto(address)
        act(page, page.locator(f"[data-project='{folder.name}']"), "Delete")
        deleted = page.get_by_role("button", name=re.compile(r"Deleted projects \(\d+\)"))
        expect(deleted).to_be_visible()
        answer_first(page, "**/api/trash", lambda route: route.abort())
        deleted.click()
        expect(page.get_by_role("alert")).to_contain_text("does not answer")
        page.get_by_role("button", name="Try again").click()
        row = page.get_by_role("dialog").locator(f"[data-project='{folder.name}']")
        expect(row).to_be_visible()
        page.request.post(
            f"{address}/api/projects/untrash",
            data={"undo_token": token_of(page, address, folder.name)},
            headers={"X-Rooftrack": "1", "Origin": address},
        )  # by another window
        row.get_by_role("button", name="Restore").click()
        expect(page.get_by_role("alert")).to_contain_text("The trash no longer holds this project.")
        expect(page.locator(f"[data-project='{folder.name}']")).to_have_count(1)


def token_of(page: Page, address: str, name: str) -> str:
    """Return what fetches a deleted project back."""
    (token,) = [
        deleted["undo_token"] for deleted in page.request.get(f"{address}/api/trash").json() if deleted["id"] == name
    ]
    return token


def act(page: Page, card, item: str, name: str | None = None) -> None:
    """Choose an action of a project's menu, and answer with a name where it asks for one."""
    card.get_by_role("button", name="Actions for").click()
    page.get_by_role("menuitem", name=item).click()
    if name is not None:
        page.get_by_role("dialog").get_by_role("textbox").fill(name)
        page.keyboard.press("Enter")
