"""What a person has to know is told where it arises: results of an earlier state, contradictions, what is missing."""

from __future__ import annotations

import json
import re
import shutil

from playwright.sync_api import Page, expect

from core.project import read_project
from core.results import read_history_csv
from tests.browser.live import SAMPLE, ask, edit_elsewhere, eventually, free_port, serving, watched
from tests.browser.steps import ready, saved

FRAMES = 600


def change(folder, **changes) -> None:
    """Edit a project by hand, as another program would."""
    document = json.loads((folder / "project.json").read_text())
    (folder / "project.json").write_text(json.dumps(document | changes))


def is_stale(pages: str) -> bool:
    return bool(ask(pages, "results")["stale"])


def note(page: Page):
    """What stands above results that are not the project's as it stands."""
    return page.locator(".note.banner")


def test_undo_makes_results_anew_as_the_edit_did(browser, measured):
    folder, pages = measured
    with watched(browser, pages) as page:
        page.goto(f"{pages}/review?frame=30")
        expect(page.locator(".review-frame")).to_have_attribute("data-frame", "30", timeout=60_000)
        page.keyboard.press("x")
        statuses = lambda: read_history_csv(folder / "results" / "roof.csv").status  # noqa: E731
        eventually(lambda: statuses()[30] == "excluded" and not is_stale(pages), seconds=90)
        expect(page.get_by_text("Solving again…")).to_be_hidden()
        page.keyboard.press("Control+z")
        eventually(lambda: statuses()[30] == "ok" and not is_stale(pages), seconds=90)
        expect(page.get_by_label("This frame", exact=True)).not_to_contain_text("excluded")
        expect(note(page)).to_have_count(0)


def test_every_page_with_results_says_which_are_older_and_leads_to_new_ones(browser, measured):
    folder, pages = measured
    intervals = json.loads((folder / "project.json").read_text())["intervals_s"]
    change(folder, intervals_s=intervals | {"residual": [17.5, 19.5]})
    with watched(browser, pages) as page:
        for step in ("drift", "review"):  # what is seen follows the project, the files do not yet
            page.goto(f"{pages}/{step}")
            expect(note(page)).to_contain_text("the files are older", timeout=60_000)
        page.get_by_role("button", name="Update the files").click()
        eventually(lambda: not is_stale(pages), seconds=90)
        expect(note(page)).to_have_count(0)
        targets = json.loads((folder / "project.json").read_text())["targets"]
        targets[0]["lines"]["L1"]["width_m"] += 0.01
        change(folder, targets=targets)
        for step in ("review", "drift", "export"):  # the video has to be measured again
            page.goto(f"{pages}/{step}")
            expect(note(page)).to_contain_text("from before the change", timeout=60_000)
            expect(note(page).get_by_role("link", name="Go to Track")).to_be_visible()
            expect(page.get_by_role("alert")).to_have_count(0)


def test_results_changed_by_another_window_are_marked_in_this_one(browser, measured):
    _, pages = measured
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.locator(".warnings")).not_to_be_empty()
        expect(note(page)).to_have_count(0)
        edit_elsewhere(page, pages, excluded_frames=[[5, 6]])
        expect(note(page)).to_contain_text("the files are older", timeout=60_000)


def test_intervals_that_overlap_are_told_beside_their_fields(browser, measured):
    folder, pages = measured
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.locator(".warnings")).not_to_be_empty()
        words = page.get_by_label("Filter and intervals").get_by_role("status").filter(has_text="share")
        expect(words).to_have_count(0)
        for name, value in (("Pre-event to", "8"), ("Event to", "18")):
            field = page.get_by_role("textbox", name=re.compile(f"^{name}"))
            field.fill(value)
            field.press("Enter")
        expect(words).to_contain_text("Pre-event and event share 7.00 to 8.00 s.")
        expect(words).to_contain_text("Event and residual share 17.00 to 18.00 s.")
        # An interval turned round keeps what was typed; its other end gives way.
        field = page.get_by_role("textbox", name="Residual to")
        field.fill("10")
        field.press("Enter")
        saved(page)
        assert read_project(folder).intervals_s.residual == (9.0, 10.0)
        expect(field).to_have_value("10.00")


def test_a_drift_without_a_frame_says_why(browser, measured):
    folder, pages = measured
    change(folder, excluded_frames=[[0, FRAMES - 1]])
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.locator(".drift-main")).to_contain_text("Every frame is excluded", timeout=60_000)
        expect(page.get_by_role("alert")).to_have_count(0)


def test_typed_pixels_beside_the_frame_are_told_and_kept(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.locator("#pairs tbody tr[data-id='3']").click()
        field = page.get_by_role("textbox", name="u", exact=True)
        field.fill("1300")
        field.press("Enter")
        expect(page.locator("#fit .note")).to_contain_text("Pair 3 lies outside the 1280 × 720 frame")
        expect(field).to_have_value("1300.00")
        step = page.locator("[data-step=correspondences]")
        expect(step).to_have_attribute("title", re.compile("Pair 3 lies outside"))


def test_a_review_without_its_video_says_so(browser, measured):
    folder, pages = measured
    (folder / "video.mp4").rename(folder / "moved.mp4")
    with watched(browser, pages) as page:
        page.goto(f"{pages}/review")
        expect(page.get_by_role("heading", name="The video cannot be shown")).to_be_visible()
        expect(page.locator("#main")).to_contain_text("video.mp4: not found")
        page.get_by_role("link", name="Go to Inputs").click()
        expect(page.locator("[data-step=inputs]")).to_have_attribute("title", re.compile("Not found: video"))


def test_a_frame_asked_for_while_the_server_is_gone_comes_when_it_is_back(browser, headless, tmp_path):
    shutil.copytree(headless, tmp_path / "sample")
    port = free_port()
    with watched(browser, f"http://127.0.0.1:{port}") as page:
        with serving(tmp_path, port) as address:
            page.goto(f"{address}/p/sample/review?frame=30")
            expect(page.get_by_label("This frame", exact=True)).to_contain_text("used", timeout=60_000)
            before = page.locator("main").bounding_box()
        bar = page.get_by_text("The server does not answer – trying again")
        expect(bar).to_be_visible(timeout=20_000)
        whole, main = page.locator(".connection-bar").bounding_box(), page.locator("main").bounding_box()
        assert main["y"] == before["y"] + whole["height"] == whole["y"] + whole["height"]
        assert main["y"] + main["height"] == before["y"] + before["height"]  # the page gives way, and is still whole
        page.keyboard.press("End")
        expect(page.get_by_label("This frame", exact=True)).to_contain_text("Frame 599")
        expect(page.locator(".toast")).to_have_count(0)  # the bar says it already
        with serving(tmp_path, port):
            expect(bar).to_be_hidden(timeout=20_000)
            expect(page.get_by_label("This frame", exact=True)).to_contain_text("used", timeout=60_000)
            expect(page.locator(".review-frame")).to_have_attribute("data-frame", "599")


def test_in_a_narrow_window_two_wide_pictures_lie_one_above_the_other(browser, project):
    _, pages = project
    with watched(browser, pages, viewport={"width": 1100, "height": 800}) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        panes = page.locator(".stage-body.two > *")
        first, second = (panes.nth(i).bounding_box() for i in range(2))
        assert second["y"] >= first["y"] + first["height"]
        page.goto(f"{pages}/regions")
        ready(page, "Reference frame")
        page.get_by_role("button", name="Frame", exact=True).or_(page.get_by_role("radio", name="Frame")).first.click()
        alone, stage = page.locator("#frame").bounding_box(), page.locator(".stage-body").bounding_box()
        assert alone["height"] == stage["height"]


def test_what_is_wrong_with_an_input_is_told_once_on_its_card(browser, project):
    folder, pages = project
    (folder / "other.yaml").write_text((SAMPLE / "lens.yaml").read_text().replace("1280", "640"))
    inputs = json.loads((folder / "project.json").read_text())["inputs"]
    change(folder, inputs=inputs | {"lens": "other.yaml"})
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        words = page.get_by_text("calibrate with the same video mode")
        expect(words).to_have_count(1)
        expect(
            page.locator(".input-card[data-kind=lens]").get_by_text("calibrate with the same video mode")
        ).to_be_visible()
        expect(page.locator(".problems .note")).to_have_count(0)
        change(folder, inputs=inputs | {"lens": None})  # what no card says stands above them
        page.reload()
        expect(page.locator(".problems .note")).to_contain_text("Lens: missing")


def test_a_project_that_cannot_be_opened_has_the_header_of_all_pages(browser, project):
    folder, pages = project
    targets = json.loads((folder / "project.json").read_text())["targets"]
    change(folder, targets=[targets[0] | {"name": "the roof"}])
    with watched(browser, pages, color_scheme="dark") as page:
        page.goto(f"{pages}/regions")
        expect(page.get_by_text('Target: "the roof" cannot be the name of a file')).to_be_visible()
        expect(page.locator(".brand svg")).to_be_visible()
        page.get_by_role("button", name="light").click()
        expect(page.locator("html")).to_have_attribute("data-theme", "light")


STAGE_SHOWN = """async (stage) => {
    const card = (await import("/static/js/components/job-card.js")).jobCard();
    card.show({ id: 1, kind: "cloud", state: "running", stage, message: "", done: 1, total: 2, rate_per_s: null });
    return card.element.textContent;
}"""


def test_a_stage_is_told_in_words_of_the_pages(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/inputs")
        for stage, words in {
            "cloud": "Reading the cloud",
            "calibration": "Looking at the pictures",
            "": "Starting",
        }.items():
            assert page.evaluate(STAGE_SHOWN, stage).startswith(words)


def test_a_damaged_cloud_is_told_without_the_way_to_it(browser, project):
    folder, pages = project
    (folder / "cut.laz").write_bytes((SAMPLE / "site.laz").read_bytes()[:1_000_000])
    change(folder, inputs=json.loads((folder / "project.json").read_text())["inputs"] | {"cloud": "cut.laz"})
    with watched(browser, pages) as page:
        page.goto(f"{pages}/orthoimage?view=picture")
        words = page.locator("#ground .note")
        expect(words).to_contain_text("cut.laz: ends before the table of its compressed chunks")
        expect(words).not_to_contain_text(str(folder))
