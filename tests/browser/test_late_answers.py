"""A hand is quicker than a server: what was pressed or asked before its answer came is neither lost nor mistaken."""

from __future__ import annotations

import json
import re

from playwright.sync_api import Locator, Page, expect

from core.project import read_project
from tests.browser.live import SAMPLE, arrived, hold_first, watched
from tests.browser.steps import choose_lens, ready, saved


def press_and_release_late(page: Page, element: Locator, news: Locator) -> None:
    """Press the mouse on an element, and let go once the news that this brings are shown."""
    box = element.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    expect(news).to_be_enabled()
    saved(page)
    page.mouse.up()


def test_a_step_is_gone_to_by_the_press_that_saves_a_number(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame")
        page.get_by_role("textbox", name="Height above ground").fill("18.5")
        undo = page.get_by_role("button", name="Undo: Height of roof")
        press_and_release_late(page, page.locator(".steps a[data-step=track]"), undo)
        page.wait_for_url(f"{pages}/track")
    assert read_project(folder).targets[0].height_m == 18.5


def test_a_target_is_chosen_by_the_press_that_saves_a_number(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    roof = document["targets"][0]
    (folder / "project.json").write_text(json.dumps(document | {"targets": [roof, roof | {"name": "table"}]}))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame")
        page.get_by_role("textbox", name="Height above ground").fill("18.5")
        table = page.locator("[data-target=table]")
        press_and_release_late(page, table, page.get_by_role("button", name="Undo: Height of roof"))
        expect(table).to_have_attribute("aria-selected", "true")


def test_a_pair_is_picked_out_by_the_press_that_saves_a_number(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.locator("#pairs tbody tr[data-id='3']").click()
        page.locator("#selection").get_by_role("textbox", name="u", exact=True).fill("700.25")
        undo = page.get_by_role("button", name=re.compile("^Undo: .*pair 3"))
        row = page.locator("#pairs tbody tr[data-id='5']")
        press_and_release_late(page, row, undo)
        expect(row).to_have_attribute("aria-selected", "true")
    assert read_project(folder).correspondences[2].frame_px[0] == 700.25


CHOICES_SHOWN = """async () => {
    const choices = ["a", "b"].map((value) => ({ value, name: value }));
    const { segmented } = await import("/static/js/components/segmented.js");
    window.row = segmented({ label: "Row", choices, value: "a", onChange: (value) => (window.chosen = value) });
    window.again = () => window.row.offer(choices);
    document.querySelector("#main").prepend(window.row.element);
}"""


def test_a_choice_is_made_though_it_is_offered_again_meanwhile(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame")
        page.evaluate(CHOICES_SHOWN)
        page.get_by_role("radiogroup", name="Row").get_by_role("radio", name="b").hover()
        page.mouse.down()
        page.evaluate("window.again()")  # as each frame does that is measured
        page.mouse.up()
        assert page.evaluate("window.chosen") == "b"


def test_redo_follows_undo_before_it_is_answered(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        pair = page.locator("#pairs tbody tr[data-id='3']")
        pair.click()
        page.keyboard.press("Delete")
        saved(page)
        undo = hold_first(page, "**/undo")
        page.keyboard.press("Control+z")
        asked = arrived(page, undo)
        page.keyboard.press("Control+Shift+z")
        asked.continue_()
        expect(page.locator(".toast")).to_have_text("Redone: “Delete pair 3”")
        expect(pair).to_have_count(0)
    assert [pair.id for pair in read_project(folder).correspondences] == [1, 2, *range(4, 21)]


def test_review_begins_where_its_address_says_whatever_is_pressed_before(browser, measured):
    _, pages = measured
    with watched(browser, pages) as page:
        history = hold_first(page, "**/results/roof*")
        page.goto(f"{pages}/review?frame=40")
        asked = arrived(page, history)
        page.keyboard.press("ArrowRight")
        page.wait_for_url("**/review?frame=0")  # nothing is known of other frames yet
        asked.continue_()
        expect(page.locator(".player-readout")).to_contain_text("frame 40 /")


JOB_SHOWN = """async () => {
    const card = (await import("/static/js/components/job-card.js")).jobCard();
    card.show({ id: "gone", kind: "cloud", state: "running", stage: "cloud", message: "", done: 1, total: 2 });
    document.body.append(card.element);
}"""


def test_what_could_not_be_cancelled_can_be_cancelled_again(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        page.evaluate(JOB_SHOWN)
        cancel = page.locator(".job").get_by_role("button", name="Cancel")
        cancel.click()
        expect(page.get_by_role("alert")).to_have_count(1)
        expect(cancel).to_be_enabled()


def test_of_two_folders_the_one_asked_for_last_is_shown(browser, project):
    folder, pages = project
    for name in ("slow", "quick"):
        (folder / name).mkdir()
        (folder / name / f"{name}.yaml").write_text((SAMPLE / "lens.yaml").read_text())
    with watched(browser, pages) as page:
        held = hold_first(page, "**/browse*slow")
        page.goto(f"{pages}/inputs")
        path = choose_lens(page)
        path.fill(str(folder / "slow"))
        path.press("Enter")
        asked = arrived(page, held)
        path.fill(str(folder / "quick"))
        path.press("Enter")
        quick = page.get_by_role("option", name="quick.yaml")
        expect(quick).to_be_visible()
        with page.expect_response("**/browse*slow"):
            asked.continue_()
        page.evaluate("new Promise(requestAnimationFrame)")
        expect(quick).to_be_visible()
        expect(path).to_have_value(str(folder / "quick"))


def test_a_double_click_on_a_folder_takes_no_file_in_it(browser, project):
    folder, pages = project
    (folder / "a").mkdir()
    (folder / "a" / "lens.yaml").write_text((SAMPLE / "lens.yaml").read_text())
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        path = choose_lens(page)
        path.fill(str(folder))
        path.press("Enter")
        inner, file = page.locator("[data-path$='/a']"), page.get_by_role("option", name="lens.yaml")
        box = inner.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        for clicks in (1, 2):
            page.mouse.down(click_count=clicks)
            page.mouse.up(click_count=clicks)
            expect(file).to_be_visible()
        expect(file).to_have_attribute("aria-selected", "false")
        file.dblclick()
        expect(page.get_by_role("dialog")).to_have_count(0)
        saved(page)
    assert read_project(folder).inputs.lens == "a/lens.yaml"


def test_a_choice_is_in_the_address_at_once(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.locator("#pairs tbody tr[data-id='3']").click()
        page.wait_for_url(re.compile(r"pair=3\b"))
        page.wait_for_timeout(300)  # what is chosen much sooner is one of many in quick turn
        row = page.locator("#pairs tbody tr[data-id='5']")
        assert "pair=5" in row.evaluate("row => (row.click(), location.search)").split("?")[1].split("&")
