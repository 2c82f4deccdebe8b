"""What a person expects of the pages besides their work: no surprise after a slip, a second thought, another look."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from core.project import read_project
from tests.browser.hands import click_at, drawn, fitted
from tests.browser.live import ask, eventually, watched
from tests.browser.steps import FRAME_SIZE, NO_DOUBLE_CLICK_MS, make_orthoimage, ortho_px, pane, ready, saved


def test_messages_add_no_scrollbar_and_do_not_pile_up(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        for _ in range(2):
            page.evaluate("""async () => (await import("/static/js/components/toast.js")).toast("A word.")""")
        expect(page.get_by_text("A word.")).to_have_count(1)  # said twice, shown once
        expect(page.get_by_text("A word.")).to_be_visible()
        assert page.evaluate("document.documentElement.scrollHeight") == page.evaluate("innerHeight")


def test_a_message_lies_over_no_tool_and_takes_no_click_from_what_lies_below_it(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.evaluate(
            """async () => (await import("/static/js/components/toast.js")).toast("A word.", { seconds: 0 })"""
        )
        words, side = page.locator(".toast"), page.locator(".side").bounding_box()
        over = words.bounding_box()
        assert side["x"] < over["x"] < over["x"] + over["width"] < side["x"] + side["width"]
        assert over["y"] > page.locator("#selection").bounding_box()["y"] + 100
        middle = over["x"] + over["width"] / 2, over["y"] + over["height"] / 2
        page.mouse.click(*middle)
        expect(page.locator("#pairs tbody tr[aria-selected=true]")).to_have_count(1)
        words.get_by_role("button", name="Dismiss").click()
        expect(words).to_have_count(0)


def click_share(page: Page, share: tuple[float, float]) -> None:
    """Click the whole reference frame at a share of its width and height."""
    lies = fitted(page, pane(page, "Reference frame"), FRAME_SIZE)
    page.mouse.click(*np.round(lies.window(np.array(FRAME_SIZE) * share)))


def test_undo_takes_back_what_was_done_last(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        half, pair = page.locator("[data-id='pair-21'].pending"), page.locator("#pairs tbody tr[data-id='3']")
        click_share(page, (0.03, 0.5))
        expect(half).to_have_count(1)
        pair.click()
        page.keyboard.press("Delete")
        expect(pair).to_have_count(0)
        saved(page)
        page.keyboard.press("Control+z")
        expect(pair).to_have_count(1)
        expect(half).to_have_count(1)
        page.keyboard.press("Control+z")
        expect(half).to_have_count(0)
        page.keyboard.press("Control+Shift+z")
        expect(half).to_have_count(1)
        page.keyboard.press("Control+Shift+z")
        expect(page.locator(".toast")).to_have_text("Redone: “Delete pair 3”")
        expect(pair).to_have_count(0)

        page.get_by_role("button", name="Import and export").click()
        page.get_by_role("menuitem", name="Delete all pairs").click()
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(0)
        expect(half).to_have_count(0)
        saved(page)
        page.keyboard.press("Control+z")
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(19)
        expect(half).to_have_count(1)
        saved(page)
        assert [pair.id for pair in read_project(folder).correspondences] == [1, 2, *range(4, 21)]
        for _ in range(5):  # faster than it is answered, and more than there is
            page.keyboard.press("Control+z")
        expect(page.locator(".toast")).to_have_text("Undone: “Delete pair 3”")
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(20)
        expect(page.get_by_role("button", name="Undo (Ctrl+Z)")).to_be_disabled()
        expect(page.get_by_role("alert")).to_have_count(0)
        saved(page)
    assert [pair.id for pair in read_project(folder).correspondences] == [*range(1, 21)]


def test_a_band_is_drawn_again_over_the_old_one(browser, project):
    folder, pages = project
    before = read_project(folder).targets[0].lines
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Orthorectified")
        grid = ask(pages, "rectified")["grid"]
        ends = np.array([before.L1.from_m, before.L1.to_m])
        row = page.locator(".band-row[data-line=L1]")
        row.get_by_role("button", name="Redraw").click()
        old = page.locator("#plan [data-id='band:L1:band']")
        assert float(old.evaluate("shape => getComputedStyle(shape).opacity")) < 1
        inside = [ends[0] * 0.8 + ends[1] * 0.2, ends[0] * 0.2 + ends[1] * 0.8]
        for place in (*inside, ends.mean(axis=0) + [0.0, 0.1]):
            click_at(page, pane(page, "Orthorectified"), (grid["width"], grid["height"]), ortho_px(grid, place))
            page.wait_for_timeout(NO_DOUBLE_CLICK_MS)
        expect(row.locator(".found")).to_contain_text("points")
        saved(page)
    after = read_project(folder).targets[0].lines
    assert np.array([after.L1.from_m, after.L1.to_m]) == pytest.approx(np.array(inside), abs=0.02)
    assert (after.L2, after.T1) == (before.L2, before.T1)


def test_another_reference_frame_asks_what_becomes_of_the_pairs(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        with page.expect_response("**/inputs"):
            page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        field, dialog = page.get_by_label("Reference frame", exact=True), page.get_by_role("dialog")

        def choose(frame: int) -> None:
            field.fill(str(frame))
            page.keyboard.press("Enter")

        choose(9999)
        expect(field).to_have_attribute("aria-invalid", "true")
        choose(300)
        expect(dialog).to_contain_text("20 pairs were clicked in frame 0")
        dialog.get_by_role("button", name="Cancel").click()
        expect(field).to_have_value("0")
        choose(300)
        dialog.get_by_role("button", name="Delete the pairs").click()
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(0)
        expect(page.locator(".pane-chip", has_text="Frame 300")).to_be_visible()
        page.get_by_role("button", name="Undo: Reference frame 300, pairs deleted").click()
        expect(page.locator("#pairs tbody tr[data-id]")).to_have_count(20)
        expect(field).to_have_value("0")
        choose(30)
        dialog.get_by_role("button", name="Keep the pairs").click()
        saved(page)
    now = read_project(folder)
    assert (now.reference_frame, len(now.correspondences)) == (30, 20)


def test_a_reference_frame_beyond_the_video_is_an_error_of_its_step(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    (folder / "project.json").write_text(json.dumps(document | {"reference_frame": 9999}))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        step = page.locator("[data-step=correspondences]")
        expect(step).to_have_attribute("data-status", "error")
        expect(step).to_have_attribute("title", re.compile("the video ends with frame 599"))


def test_a_roof_lies_below_the_camera_and_its_points_as_far_apart_as_told(browser, project):
    folder, pages = project
    before = read_project(folder)
    with watched(browser, pages) as page:
        with page.expect_response("**/fit"):
            page.goto(f"{pages}/regions")
        ready(page, "Orthorectified")
        height, apart = (page.get_by_role("textbox", name=name) for name in ("Height above ground", "P1–P2 distance"))
        height.fill("60")
        page.keyboard.press("Enter")
        expect(page.get_by_role("alert")).to_contain_text("The camera is 42")
        page.keyboard.press("Escape")
        expect(height).to_have_value(f"{before.targets[0].height_m:.2f}")
        for told, look in ((1.22, "note"), (1.26, "note warn"), (2.0, "note bad")):
            apart.fill(str(told))
            page.keyboard.press("Enter")
            words = page.locator("#bands .note")
            expect(words).to_contain_text(f"{told:.3f} m is given")
            assert words.get_attribute("class").strip() == look
        saved(page)
    assert read_project(folder).targets[0].height_m == before.targets[0].height_m


def test_a_number_field_says_what_it_takes(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        with page.expect_response("**/inputs"):
            page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        field, words = page.get_by_label("Reference frame", exact=True), page.get_by_role("alert")
        for typed in ("9999", "abc", "3.5"):
            field.fill(typed)
            page.keyboard.press("Enter")
            expect(words).to_have_text("A whole number from 0 to 599, please.")
            page.keyboard.press("Escape")
            expect(field).to_have_value("0")
        field.press("ArrowDown")
        expect(words).to_be_visible()
        field.fill("")
        expect(words).to_be_hidden()


def test_arrows_nudge_after_a_pair_is_looked_up(browser, project):
    folder, pages = project
    before = read_project(folder).correspondences
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.keyboard.press("n")
        page.keyboard.press("ArrowRight")
        page.locator("#pairs tbody tr[data-id='3']").click()
        page.keyboard.press("Shift+ArrowRight")
        page.get_by_role("button", name="Undo: Nudge pair 3").wait_for()
        row = page.locator("#pairs tbody tr[data-id='3']")
        row.focus()
        page.keyboard.press("ArrowDown")  # in the table by keys: it stays there
        expect(page.locator("#pairs tbody tr[data-id='4']")).to_be_focused()
        page.keyboard.press("ArrowRight")
        saved(page)
    moved = [b.frame_px[0] - a.frame_px[0] for a, b in zip(before, read_project(folder).correspondences, strict=True)]
    assert moved[:4] == pytest.approx([0.1, 0.0, 1.0, 0.1])


def test_the_keyboard_aims_only_when_it_is_used(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        aim = page.locator("[data-id=aim]")
        click_share(page, (0.03, 0.5))
        expect(page.locator("[data-id='pair-21']")).to_have_count(1)
        expect(aim).to_have_count(0)
        page.keyboard.press("n")
        expect(aim).to_have_count(0)
        page.keyboard.press("+")
        expect(aim).to_have_count(1)


def test_a_click_completes_the_oldest_half_or_the_one_picked_out(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        hint = pane(page, "Orthoimage").locator(".attention")
        for u in (0.03, 0.06):
            click_share(page, (u, 0.5))
            page.wait_for_timeout(NO_DOUBLE_CLICK_MS)
        expect(page.locator("#selection h2")).to_have_text("Pair 22, unfinished")
        expect(hint).to_have_text("Click completes pair 21")
        click_share(page, (0.06, 0.5))
        expect(page.locator("#selection h2")).to_have_text("Pair 22, unfinished")
        expect(hint).to_have_text("Click completes pair 22")
        page.wait_for_timeout(NO_DOUBLE_CLICK_MS)
        click_share(page, (0.5, -0.1))  # beside the picture
        expect(page.locator(".toast")).to_contain_text("click within the picture")
        expect(page.locator("#selection h2")).to_have_text("Pair 22, unfinished")


def test_residuals_are_as_long_in_both_pictures_and_say_how_enlarged(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    document["inputs"]["cloud"] = "../footage/site.laz"
    (folder / "project.json").write_text(json.dumps(document))
    with watched(browser, pages) as page:
        make_orthoimage(page, pages, "4")
        page.goto(f"{pages}/correspondences")
        ready(page, "Orthoimage")
        for name in ("Reference frame", "Orthoimage"):
            expect(pane(page, name).locator(".legend")).to_have_text(re.compile(r"^→ residuals × \d+"))
            order = pane(page, name).evaluate(
                "pane => [...pane.querySelectorAll('.shapes > g')].map(g => g.dataset.id)"
            )
            assert max(i for i, shape in enumerate(order) if shape.startswith("residual")) < order.index("pair-1")
        lengths = [arrow_length(page, name, 13) for name in ("Reference frame", "Orthoimage")]
        assert lengths[0] == pytest.approx(lengths[1], rel=0.1)
        page.keyboard.press("r")
        expect(page.locator(".legend:visible")).to_have_count(0)


def arrow_length(page: Page, name: str, number: int) -> float:
    path = pane(page, name).locator(f"[data-id=residual-{number}] .ink").get_attribute("d")
    tail, head = (np.array(place.split(" "), dtype=float) for place in re.findall(r"[ML]([-\d. ]+)", path)[:2])
    return float(np.hypot(*(head - tail)))


def test_the_loupe_shows_the_picture_that_is_shown(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        lies = fitted(page, pane(page, "Reference frame"), FRAME_SIZE)
        page.mouse.move(*np.round(lies.window(np.array(FRAME_SIZE) * [0.1, 0.9])))
        loupe = pane(page, "Reference frame").locator(".loupe canvas")
        pixels = "canvas => canvas.toDataURL()"
        expect(loupe).to_be_visible()
        drawn(page, pane(page, "Reference frame"), lies.scale)
        before = loupe.evaluate(pixels)
        page.keyboard.press("u")
        expect(page.locator(".pane-chip", has_text="undistorted")).to_be_visible()
        eventually(lambda: loupe.evaluate(pixels) != before)


def test_the_fit_stays_where_it_is_when_a_pair_is_switched_off(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        figures, table = page.locator("#fit .figures"), page.locator("#pairs")
        expect(figures).to_contain_text("20")
        before = table.bounding_box()
        page.get_by_role("checkbox", name="Pair 2 counts").click()
        expect(figures).to_contain_text("19 / 20")
        assert table.bounding_box() == before


def test_a_look_at_what_is_not_there_yet_is_no_error(browser, project):
    folder, pages = project
    address = pages.split("/p/")[0]
    bare = folder.with_name("without-a-video")
    bare.mkdir()
    (bare / "project.json").write_text(json.dumps({"rooftrack": 1, "name": "bare", "inputs": {"video": "video.mp4"}}))
    refused: list[str] = []
    with watched(browser, pages) as page:
        page.on("response", lambda answer: refused.append(answer.url) if answer.status >= 400 else None)
        page.goto(address)
        expect(page.locator(".project-card", has_text="bare")).to_be_visible()
        page.goto(f"{pages}/inputs")
        expect(page.locator(".input-card[data-kind=lens]")).to_contain_text("not in the file")
        page.goto(f"{pages}/track")
        expect(page.get_by_role("button", name="Start")).to_be_visible()
        page.goto(f"{pages}/export")
        expect(page.get_by_role("heading", name="Nothing measured yet")).to_be_visible()
        assert refused == []
        page.goto(f"{address}/p/deleted-meanwhile")
        expect(page.locator("#main")).to_contain_text("there is no such project")
        expect(page.get_by_role("link", name="All projects")).to_be_visible()


def test_undo_follows_a_number_typed_by_mistake(browser, project):
    folder, pages = project
    before = read_project(folder).targets[0].height_m
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame")
        height = page.get_by_role("textbox", name="Height above ground")
        height.fill("18.5")
        height.press("Enter")
        page.get_by_role("button", name="Undo: Height of roof").wait_for()
        height.press("Control+z")
        saved(page)
        expect(height).to_have_value(f"{before:.2f}")
        height.press("9")  # what is being typed is the field's own
        height.press("Control+z")
        page.get_by_role("button", name="Redo: Height of roof").wait_for()
    assert read_project(folder).targets[0].height_m == before


def test_two_targets_never_share_a_result_file(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        page.get_by_role("button", name="Add target").click()
        page.get_by_role("menuitem", name="Three lines").click()
        page.locator("#targets li[data-target=table]").get_by_role("button", name="Actions for").click()
        page.get_by_role("menuitem", name="Rename…").click()
        page.get_by_role("dialog").get_by_role("textbox").fill("ROOF")
        page.keyboard.press("Enter")
        refused = page.get_by_role("dialog").get_by_role("alert")
        expect(refused).to_contain_text("would share a result file")
        page.get_by_role("dialog").get_by_role("textbox").fill("_table")
        page.keyboard.press("Enter")
        expect(refused).to_contain_text("a letter or digit first")
        page.get_by_role("dialog").get_by_role("textbox").fill(" ")
        page.keyboard.press("Enter")
        expect(refused).to_have_text("A name, please.")
        page.keyboard.press("Escape")
        expect(page.locator("#targets li[data-target=table]")).to_be_visible()
    assert [target.name for target in read_project(folder).targets] == ["roof"]


def test_a_very_long_name_leaves_room_for_the_rest(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    name = "A name that tells everything about the project. " * 10
    (folder / "project.json").write_text(json.dumps(document | {"name": name.strip()}))
    with watched(browser, pages) as page:
        page.goto(pages.split("/p/")[0])
        title = page.locator(f"[data-project='{folder.name}'] h2")
        expect(title).to_have_attribute("title", name.strip())
        assert title.bounding_box()["height"] < 50
        page.goto(f"{pages}/track")
        expect(page.locator(".project-name")).to_have_attribute("title", name.strip())
        assert page.locator("#header").bounding_box()["height"] < 60


def test_a_click_beside_a_dialog_throws_away_nothing_that_was_entered(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(pages.split("/p/")[0])
        page.get_by_role("button", name="New project").first.click()
        name = page.get_by_label("Name", exact=True)
        name.fill("EQ7")
        page.mouse.click(5, 5)
        expect(name).to_have_value("EQ7")
        page.keyboard.press("Escape")
        expect(page.get_by_role("dialog")).to_have_count(0)
        page.get_by_role("button", name="Keys and gestures").click()
        expect(page.get_by_role("dialog")).to_be_visible()
        page.mouse.click(5, 5)  # nothing to lose in a list of keys
        expect(page.get_by_role("dialog")).to_have_count(0)


def test_the_page_of_a_deleted_project_offers_to_restore_it(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame")
        page.evaluate(f"""async () => (await import("/static/js/lib/api.js")).remove("projects/{folder.name}")""")
        page.reload()
        expect(page.locator("#main")).to_contain_text("there is no such project")
        page.get_by_role("button", name="Restore the deleted project").click()
        ready(page, "Reference frame")
    assert (folder / "project.json").exists()
