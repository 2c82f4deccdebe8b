"""Track, review, drift, export as a person uses them, on the shipped sample."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import APIResponse, Page, Response, Route, expect

from core.drift import high_pass
from core.project import read_project
from core.results import read_history_csv
from core.run import run_project
from tests.browser.live import (
    answer_first,
    arrived,
    ask,
    edit_elsewhere,
    eventually,
    free_port,
    hold_first,
    serving,
    watched,
)
from tests.browser.steps import FRAME_SIZE

FRAMES = 600
FRAME = 300  # in the middle of the shaking
WITHIN_PX = 0.5
SAME_M = 1e-5  # the contract's: what stopping and going on may change


@pytest.fixture(scope="module")
def finished(headless, server):
    """The address of a project's pages that no test changes."""
    workspace, address = server
    shutil.copytree(headless, workspace / "finished")
    return f"{address}/p/finished"


@pytest.fixture
def project(measured):
    """A project of its own for a test that changes it: its folder and its pages' address."""
    return measured


def test_tracking_is_cancelled_survives_the_server_and_ends_as_the_headless_engine(browser, headless, tmp_path):
    shutil.copytree(headless, tmp_path / "sample", ignore=shutil.ignore_patterns("results"))
    port = free_port()
    with serving(tmp_path, port) as address, watched(browser, address) as page:
        page.goto(f"{address}/p/sample/track")
        page.get_by_role("button", name="Start").dblclick()  # as people do; it is started once
        page.wait_for_function("() => parseInt(document.querySelector('.figures .value')?.textContent) > 5")
        expect(page.locator("[data-step=track]")).to_have_attribute("data-status", "running")
        expect(page.locator(".toast")).to_have_count(0)
        held: list[Route] = []
        released: list[bool] = []
        page.route(
            "**/track",
            lambda route: route.continue_() if released or route.request.method != "GET" else held.append(route),
        )
        page.get_by_role("button", name="Cancel").hover()
        before = page.locator(".figures .value").first.inner_text()
        page.mouse.down()
        expect(page.locator(".figures .value").first).not_to_have_text(before)  # a slow hand, and news come meanwhile
        page.mouse.up()
        expect(page.get_by_text("Reading what was kept…")).to_be_visible()
        expect(page.get_by_role("button", name="Start")).to_have_count(0)
        page.keyboard.press("r")  # what would be started is not known yet
        arrived(page, held)
        released.append(True)
        for route in held:
            route.continue_()
        expect(page.locator("[data-step=track]")).to_have_attribute("data-status", "warn")
        expect(page.get_by_role("button", name="Resume")).to_be_visible()
    with serving(tmp_path, port) as address, watched(browser, address) as page:
        kept = ask(f"{address}/p/sample", "track")["frames_done"]
        assert 5 < kept < FRAMES
        page.goto(f"{address}/p/sample/track")
        expect(page.locator(".note.info")).to_contain_text(f"{kept} of {FRAMES} frames")
        page.keyboard.press("r")
        expect(page.get_by_role("link", name="Review the result")).to_be_visible(timeout=240_000)
        page.goto(f"{address}/p/sample/export")
        with page.expect_download() as download:
            page.wait_for_selector("a[data-main]")
            page.keyboard.press("d")
        assert download.value.suggested_filename.endswith("roof.csv")
        downloaded = Path(download.value.path()).read_bytes()
    run_project(tmp_path / "sample")
    assert downloaded == (tmp_path / "sample" / "results" / "roof.csv").read_bytes()
    again = tmp_path / "sample"
    resumed, straight = (read_history_csv(folder / "results" / "roof.csv") for folder in (again, headless))
    assert resumed.status.tolist() == straight.status.tolist()
    assert np.nanmax(np.abs(resumed.p1_m - straight.p1_m)) < SAME_M  # a lost frame has no value in either


def test_a_server_that_is_gone_is_noticed_and_found_again(browser, headless, tmp_path):
    shutil.copytree(headless, tmp_path / "sample", ignore=shutil.ignore_patterns("results"))
    port = free_port()
    with watched(browser, f"http://127.0.0.1:{port}") as page:
        bar = page.get_by_text("The server does not answer")
        with serving(tmp_path, port) as address:
            page.goto(f"{address}/p/sample/track")
            page.get_by_role("button", name="Start").click()
            expect(page.get_by_text("The first values appear after 8 frames.")).to_be_visible()
            page.wait_for_function("() => parseInt(document.querySelector('.figures .value')?.textContent) > 5")
            expect(bar).to_be_hidden()
        expect(bar).to_be_visible(timeout=20_000)
        expect(page.locator("progress.frozen")).to_be_visible()
        expect(page.get_by_role("button", name="Cancel")).to_be_disabled()
        with serving(tmp_path, port):
            expect(bar).to_be_hidden(timeout=20_000)
            expect(page.get_by_role("link", name="Review the result")).to_be_visible(timeout=240_000)


def test_a_method_not_measured_yet_is_a_state_and_no_error(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/track")
        expect(page.get_by_role("link", name="Review the result")).to_be_visible(timeout=30_000)
        page.get_by_role("radio", name="Paper").click()
        expect(page.locator(".note.info")).to_contain_text("Not measured by this method yet")
        expect(page.get_by_role("button", name="Start", exact=True)).to_be_visible()
        expect(page.locator(".note.good")).to_have_count(0)
        expect(page.locator(".plot-stack.faint")).to_be_visible()  # the other method's curve stays in sight
        eventually(lambda: read_project(folder).method == "paper")
        page.wait_for_timeout(1000)
        assert page.locator(".toast").all_inner_texts() == []
        with page.expect_response(lambda answer: "/review/" in answer.url) as overlay:
            page.goto(f"{pages}/review")
        assert overlay.value.ok  # what is measured is shown, by the method that has measured it
        page.wait_for_timeout(1000)
        assert page.locator(".toast").all_inner_texts() == []
        page.goto(f"{pages}/drift")
        expect(page.get_by_role("heading", name="Not measured by the paper method yet")).to_be_visible(timeout=30_000)


def test_an_answer_from_before_a_method_was_chosen_is_not_taken_for_the_new_one(browser, project):
    _, pages = project
    asked: list[Route] = []
    held: list[tuple[Route, APIResponse]] = []

    def hold_the_second(route: Route) -> None:
        asked.append(route)
        if len(asked) == 2:
            held.append((route, route.fetch()))
        else:
            route.continue_()

    with watched(browser, pages) as page:
        page.route("**/results", hold_the_second)  # a page asks at once, and when its events begin
        page.goto(f"{pages}/track")
        expect(page.get_by_role("link", name="Review the result")).to_be_visible(timeout=30_000)
        route, answer = arrived(page, held)
        page.get_by_role("radio", name="Paper").click()
        expect(page.locator(".note.info")).to_contain_text("Not measured by this method yet")
        route.fulfill(response=answer)
        page.wait_for_timeout(1000)
        expect(page.locator(".note.info")).to_contain_text("Not measured by this method yet")
        assert page.locator(".toast").all_inner_texts() == []


@pytest.mark.parametrize(("step", "values"), [("track", "/results$"), ("drift", "/api/.*/drift")])
def test_a_plot_without_values_has_no_numbers_along_its_axes(browser, finished, step, values):
    held: list[Route] = []
    answered: list[Route] = []
    with watched(browser, finished) as page:
        page.add_init_script(
            """window.written = [];
            const write = CanvasRenderingContext2D.prototype.fillText;
            CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
              if (text !== "" && this.canvas.closest(".plot")) window.written.push(text);
              write.call(this, text, ...place);
            };"""
        )
        page.route(re.compile(values), lambda route: route.continue_() if answered else held.append(route))
        page.goto(f"{finished}/{step}")
        arrived(page, held)
        expect(page.locator(".plot .u-over").first).to_be_visible()
        page.wait_for_timeout(300)  # in which a plot is drawn in its final size
        assert page.evaluate("window.written") == []
        expect(page.locator(".plot-unit:not(:empty)")).to_have_count(0)
        answered.extend(held)
        for results in answered:
            results.continue_()
        page.wait_for_function("() => window.written.some((text) => /^\\d+ s$/.test(text))")


def test_what_cannot_be_asked_is_told_and_asked_again_and_no_older_overlay_stays(browser, project):
    _, pages = project
    reviews: list[Route] = []
    troubles = [
        lambda route: route.abort(),
        lambda route: route.fulfill(status=422, json={"error": {"message": "The summary is damaged."}}),
    ]

    def trouble_at_first(route: Route) -> None:
        troubles.pop(0)(route) if troubles else route.continue_()

    def hold_the_first(route: Route) -> None:
        reviews.append(route)
        if len(reviews) > 1:
            route.continue_()

    with watched(browser, pages) as page:
        page.route("**/results", trouble_at_first)
        answer_first(page, "**/inputs", lambda route: route.abort())
        page.route("**/review/30?*", hold_the_first)
        page.goto(f"{pages}/review?frame=30")
        expect(page.get_by_role("heading", name="The results cannot be shown")).to_be_visible()
        expect(page.locator("#main")).to_contain_text(
            "The summary is damaged."
        )  # the server answers again, and refuses
        page.get_by_role("button", name="Try again").click()
        expect(page.get_by_role("heading", name="The video cannot be shown")).to_be_visible()
        older = arrived(page, reviews)
        with page.expect_response("**/results/roof*"):  # the page has begun to read everything again
            edit_elsewhere(page, pages, excluded_frames=[[30, 30]])
        older.continue_()
        at_rest(page, 30)
        eventually(lambda: len(reviews) > 1)
        expect(page.get_by_label("This frame", exact=True)).to_contain_text("excluded")


def test_a_failed_measurement_is_told_once_and_leads_to_its_remedy(browser, project):
    folder, pages = project
    message = "project.json: targets.roof.lines.T1 holds no line with two edges in the reference frame; draw it again."
    note = {"kind": "track", "state": "failed", "parameters": {}, "message": message}
    (folder / "results" / "job.json").write_text(json.dumps(note))
    document = json.loads((folder / "project.json").read_text())
    document["targets"][0]["lines"]["T1"]["width_m"] *= 1.5
    (folder / "project.json").write_text(json.dumps(document))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/track")
        told = page.get_by_text("Band T1 holds no line")
        expect(told).to_have_count(1, timeout=30_000)
        expect(page.locator(".note.bad").get_by_role("link", name="Regions")).to_be_visible()
        expect(page.locator(".toast")).to_have_count(0)


def at_rest(page: Page, frame: int) -> None:
    """Wait until a frame is on the screen with all its pixels."""
    page.wait_for_selector(f'.review-frame[data-frame="{frame}"]')
    page.wait_for_timeout(250)


@pytest.mark.parametrize("ratio", [1, 2])
def test_the_overlay_lies_where_the_engine_measured(browser, finished, ratio):
    measured = ask(finished, f"review/{FRAME}")
    with watched(browser, finished, device_scale_factor=ratio) as page:
        page.goto(f"{finished}/review?frame={FRAME}&hidden=rejected,bands,edges")
        at_rest(page, FRAME)
        box = page.locator(".review-frame").bounding_box()
        to_canvas = whole_picture(box)
        marks_agree(page, measured["targets"]["roof"], to_canvas)
        features_agree(page, np.array(measured["ground"]["used"]), to_canvas, ratio)
        page.locator(".review-frame").focus()
        for key in ["+"] * 2 + ["ArrowLeft"] * 8 + ["ArrowUp"] * 4:
            page.keyboard.press(key)
        closer = zoomed(to_canvas, np.array([box["width"], box["height"]]) / 2, 1.4**2, [8 * 40, 4 * 40])
        page.wait_for_function(MARK_IS_NEAR, arg=closer(measured["targets"]["roof"]["p1_raw"]).tolist())
        marks_agree(page, measured["targets"]["roof"], closer)
        features_agree(page, np.array(measured["ground"]["used"]), closer, ratio)


def test_a_frame_says_what_took_part_and_what_did_not(browser, finished):
    measured = ask(finished, f"review/{FRAME}")
    ground, patches = measured["ground"], measured["targets"]["roof"]["points_raw"]
    assert len(patches["used"]) > 12
    with watched(browser, finished) as page:
        page.goto(f"{finished}/review?frame={FRAME}")
        facts = page.get_by_label("This frame", exact=True)
        expect(facts).to_contain_text(f"{len(ground['used'])} features used, {len(ground['rejected'])} rejected")
        expect(facts).to_contain_text(f"{len(patches['used'])} patches used, {len(patches['rejected'])} rejected")


MARK_IS_NEAR = """([x, y]) => {
    const place = document.querySelector('[data-id="roof/p1"]').transform.baseVal.getItem(0).matrix;
    return Math.hypot(place.e - x, place.f - y) < 5;
}"""


def whole_picture(box):
    """The rule of the pixel's centre, written down again: (0, 0) is half a pixel inside the picture's corner."""
    size, video = np.array([box["width"], box["height"]]), np.array(FRAME_SIZE)
    scale = min(size / video)
    return lambda raw: scale * (np.asarray(raw, dtype=float) + 0.5 - video / 2) + size / 2


def zoomed(to_canvas, middle, factor, panned):
    return lambda raw: middle + factor * (to_canvas(raw) - middle) + panned


def marks_agree(page: Page, roof, to_canvas):
    """P1, P2 and the ends of the fitted lines, in SVG."""
    for name in ("p1", "p2"):
        drawn = page.evaluate(
            """(id) => {
                const pane = document.querySelector(".review-frame").getBoundingClientRect();
                const mark = document.querySelector(`[data-id="${id}"] .ink`).getBoundingClientRect();
                return [mark.left + mark.width / 2 - pane.left, mark.top + mark.height / 2 - pane.top];
            }""",
            f"roof/{name}",
        )
        assert np.hypot(*(drawn - to_canvas(roof[f"{name}_raw"]))) < WITHIN_PX
    for name, ends in roof["lines_raw"].items():
        path = page.locator(f'[data-id="roof/line/{name}"] .ink').get_attribute("d")
        drawn = np.array(re.findall(r"-?\d+\.?\d*", path), dtype=float).reshape(-1, 2)
        assert np.abs(drawn - to_canvas(ends)).max() < WITHIN_PX


def features_agree(page: Page, used, to_canvas, ratio):
    """Rings around ground features, on the canvas: the middle of the coloured pixels."""
    places = to_canvas(used)
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 99 * np.eye(len(places))
    box = page.locator(".review-frame").bounding_box()
    inside = np.all((places > 20) & (places < [box["width"] - 20, box["height"] - 20]), axis=1)
    alone = places[inside & (gaps.min(axis=1) > 24)][:40]
    assert len(alone) >= 8
    middles = page.evaluate(
        """([places, ratio]) => {
            const context = document.querySelector(".review-frame canvas.pixels").getContext("2d");
            const half = Math.round(8 * ratio);
            return places.map(([x, y]) => {
                const left = Math.round(x * ratio) - half, top = Math.round(y * ratio) - half;
                const { data, width, height } = context.getImageData(left, top, 2 * half, 2 * half);
                let sum = 0, across = 0, down = 0;
                for (let j = 0; j < height; j++) for (let i = 0; i < width; i++) {
                    const k = 4 * (j * width + i), green = Math.max(0, data[k + 1] - data[k] - 60);
                    sum += green; across += green * (i + 0.5); down += green * (j + 0.5);
                }
                return [(left + across / sum) / ratio, (top + down / sum) / ratio];
            });
        }""",
        [alone.tolist(), ratio],
    )
    assert np.abs(np.array(middles) - alone).max() < WITHIN_PX


def test_the_plot_and_the_player_lead_each_other(browser, finished):
    with watched(browser, finished) as page:
        page.goto(f"{finished}/review?frame={FRAME}")
        at_rest(page, FRAME)
        for frame in (FRAME + 1, FRAME + 2):
            page.keyboard.press(".")
            at_rest(page, frame)
        page.keyboard.press(",")
        at_rest(page, FRAME + 1)
        history = ask(finished, "results/roof")
        area = page.locator(".review-plots .u-over").first.bounding_box()
        page.mouse.click(area["x"] + 0.25 * area["width"], area["y"] + 30)
        times = history["time_s"]
        expected = int(np.argmin(np.abs(np.array(times) - (times[0] + 0.25 * (times[-1] - times[0])))))
        shown = int(re.search(r"frame=(\d+)", wait_for_url(page, r"frame=\d+")).group(1))
        assert abs(shown - expected) <= 1
        at_rest(page, shown)
        expect(page.locator(".facts-table tbody tr").first).to_contain_text(
            f"{1000 * history['p1_dx_m'][shown]:.2f}".replace("-", "−")
        )


def test_comparing_methods_says_what_it_takes(browser, finished):
    with watched(browser, finished) as page:
        page.goto(f"{finished}/review?frame={FRAME}")
        at_rest(page, FRAME)
        page.keyboard.press("m")
        expect(page.get_by_role("status").filter(has_text="Choose Paper on the Track page")).to_be_visible()
        expect(page.get_by_role("checkbox", name="Compare methods")).not_to_be_checked()
        page.get_by_role("button", name="Go to Track").click()
        page.wait_for_url("**/track")


def wait_for_url(page: Page, pattern: str) -> str:
    page.wait_for_timeout(400)  # the address follows after a fifth of a second
    assert re.search(pattern, page.url)
    return page.url


def test_a_filter_is_named_and_space_plays_after_a_choice_was_clicked(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    document["drift"] = {"filter": "high-pass", "corner_hz": 0.25}
    (folder / "project.json").write_text(json.dumps(document))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/review")
        expect(page.get_by_label("This frame", exact=True)).to_contain_text("σ before it", timeout=60_000)
        page.get_by_role("radio", name="Frame", exact=True).click()
        page.keyboard.press("Space")
        expect(page.get_by_role("button", name="Pause")).to_be_visible()
        page.goto(f"{pages}/track")
        page.get_by_role("link", name="High-pass 0.25").click()
        expect(page.get_by_role("heading", name="Drift", level=1)).to_be_visible()


def test_frames_drawn_over_are_excluded_and_come_back_with_undo(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/review?frame=30")
        at_rest(page, 30)
        area = page.locator(".review-plots .u-over").first.bounding_box()
        page.keyboard.down("Shift")
        page.mouse.move(area["x"] + 0.5 * area["width"], area["y"] + 40)
        page.mouse.down()
        page.mouse.move(area["x"] + 0.6 * area["width"], area["y"] + 40, steps=4)
        page.mouse.up()
        page.keyboard.up("Shift")
        page.keyboard.press("x")
        eventually(lambda: "excluded" in read_history_csv(folder / "results" / "roof.csv").status, seconds=90)
        (first, last) = read_project(folder).excluded_frames[0]
        assert first == pytest.approx(0.5 * (FRAMES - 1), abs=2)
        assert last == pytest.approx(0.6 * (FRAMES - 1), abs=2)
        history = read_history_csv(folder / "results" / "roof.csv")
        assert set(history.status[first : last + 1].tolist()) == {"excluded"}
        assert "excluded" not in history.status[:first].tolist()
        expect(page.get_by_label("Excluded frames", exact=True)).to_contain_text(f"{first}–{last}")
        page.reload()
        at_rest(page, 30)
        page.keyboard.press("Control+z")
        expect(page.get_by_label("Excluded frames", exact=True)).to_contain_text("None")
        assert read_project(folder).excluded_frames == ()


def test_the_corner_slider_shows_what_the_engine_filters(browser, project):
    folder, pages = project
    history = read_history_csv(folder / "results" / "roof.csv")
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.locator(".drift-lower .plot-legend").first).to_contain_text("East")
        before = read_project(folder).drift.corner_hz
        slider = page.get_by_role("slider", name="Corner frequency")
        slider.focus()
        corner = before + 4 * 0.005
        with page.expect_response(lambda answer: answer.url.endswith("/drift") and asks_for(answer, corner)) as asked:
            for _ in range(4):
                slider.press("ArrowRight")
        answer = asked.value.json()
        expected = high_pass(history.p1_raw_m, history.time_s, corner)
        drawn = np.array([answer["filtered"]["dx"], answer["filtered"]["dy"]], dtype=float).T
        np.testing.assert_allclose(drawn, expected, atol=1e-6)
        # The answer is here before the page has drawn it.
        expect(page.locator(".figures")).not_to_have_class(re.compile("awaited"))
        eventually(lambda: np.nanmin(np.abs(1000 * expected[:, 0] - hovered_value(page, "Filtered"))) < 0.06)
        expect(page.locator(".warnings")).not_to_be_empty()
        eventually(lambda: read_project(folder).drift.corner_hz == pytest.approx(corner))


def test_nothing_of_another_corner_stands_beside_the_new_one(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.locator(".warnings")).not_to_be_empty()
        expect(page.locator(".drift-lower .plot-playhead").first).to_be_visible()
        held = hold_first(page, "**/drift")
        line = page.locator(".drift-lower .plot-playhead").first
        before = line.bounding_box()["x"]
        page.get_by_role("slider", name="Corner frequency").focus()
        page.keyboard.press("ArrowRight")
        expect(page.locator(".figures")).to_have_class(re.compile("awaited"))
        expect(page.locator(".warnings")).to_have_class(re.compile("awaited"))
        expect(page.get_by_role("status").filter(has_text="Solving…")).to_be_visible()
        assert line.bounding_box()["x"] > before
        arrived(page, held).continue_()
        expect(page.locator(".figures")).not_to_have_class(re.compile("awaited"))
        expect(page.get_by_role("status").filter(has_text="Solving…")).to_be_hidden()


def asks_for(answer: Response, corner: float) -> bool:
    return json.loads(answer.request.post_data)["corner_hz"] == pytest.approx(corner)


def hovered_value(page: Page, label: str) -> float:
    """Millimetres a curve shows under the pointer, in the middle of the history."""
    area = page.locator(".drift-main .u-over").bounding_box()
    page.mouse.move(area["x"] + 0.5 * area["width"], area["y"] + 0.5 * area["height"])
    words = page.locator(".drift-main .plot-entry", has_text=label).locator("output")
    expect(words).not_to_be_empty()
    number, unit = words.inner_text().replace("−", "-").split(" ")
    return float(number) * {"mm": 1, "cm": 10}[unit]


def test_the_interval_of_rest_is_dragged_on_the_plot(browser, project):
    folder, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.locator(".drift-main .plot-legend")).to_contain_text("Raw")
        area = page.locator(".drift-main .u-over").bounding_box()
        with page.expect_response(re.compile(r"/drift/sweep")):
            page.mouse.move(area["x"] + 0.05 * area["width"], area["y"] + 60)
            page.mouse.down()
            page.mouse.move(area["x"] + 0.3 * area["width"], area["y"] + 60, steps=5)
            page.mouse.up()
        duration = (FRAMES - 1) / 30
        drawn = pytest.approx((0.05 * duration, 0.3 * duration), abs=0.03)
        eventually(lambda: read_project(folder).intervals_s.pre_event == drawn)
        end = read_project(folder).intervals_s.pre_event[1]
        handle = page.get_by_role("slider", name="End of pre-event")
        handle.focus()
        handle.press("Shift+ArrowLeft")
        expect(handle).to_have_attribute("aria-valuenow", f"{end - 1:.2f}")
        eventually(lambda: read_project(folder).intervals_s.pre_event[1] == pytest.approx(end - 1, abs=0.002))
        before = read_project(folder).intervals_s
        box = handle.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 60)
        page.mouse.down()
        page.mouse.move(box["x"] + 100, box["y"] + 60, steps=4)
        expect(handle).not_to_have_attribute("aria-valuenow", f"{before.pre_event[1]:.2f}")
        handle.dispatch_event("pointercancel", {"pointerId": 1})  # the system takes the drag over
        page.mouse.up()
        expect(handle).to_have_attribute("aria-valuenow", f"{before.pre_event[1]:.2f}")
        assert read_project(folder).intervals_s == before
        field = page.get_by_role("textbox", name="Residual to")
        field.fill("500")
        field.press("Enter")
        expect(page.get_by_role("alert")).to_have_text(re.compile(r"The video ends at [\d.]+ s\."))
        expect(field).to_have_attribute("aria-invalid", "true")


@pytest.mark.parametrize(
    ("towards_s", "event", "pulled"),
    [
        (4.0, (6.0, 15.0), {"pre_event": (0.0, 4.0)}),
        (8.0, (6.0, 15.0), {"event": (8.0, 15.0)}),
        (4.0, (6.0, 6.02), {"event": (4.0, 6.02)}),
        (8.0, (6.0, 6.02), {"event": (6.0, 8.0)}),
    ],
    ids=["where two meet, left", "where two meet, right", "short, left", "short, right"],
)
def test_of_handles_in_one_place_that_one_is_pulled_which_has_room(browser, project, towards_s, event, pulled):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    before = {"pre_event": (0.0, 6.0 if event[1] > 7 else 1.0), "event": event, "residual": (17.0, 19.0)}
    (folder / "project.json").write_text(json.dumps(document | {"intervals_s": before}))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/drift")
        expect(page.get_by_role("slider")).to_have_count(7)  # six ends, and the corner frequency
        area = page.locator(".drift-main .u-over").bounding_box()
        x = lambda at_s: area["x"] + area["width"] * at_s / ((FRAMES - 1) / 30)  # noqa: E731
        page.mouse.move(x(6.0), area["y"] + 60)
        page.mouse.down()
        page.mouse.move(x(towards_s), area["y"] + 60, steps=8)
        page.mouse.up()
        expected = {name: pytest.approx(interval, abs=0.03) for name, interval in (before | pulled).items()}
        eventually(lambda: dict(read_project(folder).intervals_s) == expected)
        (name,) = pulled
        start_or_end = "Start" if before[name][0] != pulled[name][0] else "End"
        slider = page.get_by_role("slider", name=f"{start_or_end} of {name.replace('_', '-')}")
        expect(slider).to_be_focused()  # and the arrow keys move it on


def test_table_2_says_what_the_summary_says(browser, headless, finished):
    gps = json.loads((headless / "results" / "summary.json").read_text())["targets"]["roof"]["gps"]
    with watched(browser, finished) as page:
        page.goto(f"{finished}/export")
        row = page.locator(".comparison tbody tr").first
        expect(row).to_contain_text("East")
        cells = [cell.replace("−", "-") for cell in row.locator("td").all_inner_texts()]
        for quantity, (video, reference, error) in zip(
            ("peak_positive_m", "peak_negative_m", "residual_m"), zip(*[iter(cells)] * 3, strict=True), strict=True
        ):
            told = gps[quantity]["x"]
            for shown, exact in (
                (video, told["video"]),
                (reference, told["gps"]),
                (error.split(" ")[0], told["error"]),
            ):
                assert float(shown) == pytest.approx(100 * exact, abs=0.0051)
        expect(page.get_by_label("GPS", exact=True)).to_contain_text(f"{1000 * gps['rms_m']['x']:.1f}")


def test_what_was_asked_of_one_target_is_not_shown_as_anothers(browser, finished):
    validation = ask(finished, "validation?target=roof")
    other = validation | {"table": [row | {"video_m": 0.1234} for row in validation["table"]]}
    late: list[Route] = []
    with watched(browser, finished) as page:
        results = ask(finished, "results")
        page.route("**/results", lambda route: route.fulfill(json=results | {"targets": ["roof", "annex"]}))
        page.route("**/validation?target=roof*", lambda route: late.append(route))
        page.route("**/validation?target=annex*", lambda route: route.fulfill(json=other))
        page.goto(f"{finished}/export")
        arrived(page, late)
        page.get_by_role("radio", name="annex").click()
        page.wait_for_timeout(500)
        for route in late:
            route.fulfill(json=validation)
        expect(page.locator(".comparison tbody tr").first).to_contain_text("12.34")
        page.wait_for_timeout(500)
        expect(page.locator(".comparison tbody tr").first).to_contain_text("12.34")


def test_a_result_from_before_a_change_says_so(browser, project):
    folder, pages = project
    document = json.loads((folder / "project.json").read_text())
    peak = json.loads((folder / "results" / "summary.json").read_text())["targets"]["roof"]["peak_negative_m"]["x"]
    first = round(peak["time_s"] * 30) - 2
    (folder / "project.json").write_text(json.dumps(document | {"excluded_frames": [[first, first + 4]]}))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/export")
        table = page.get_by_label("Peaks and residual")
        expect(table.locator(".note")).to_contain_text("5 frames of the event excluded or lost", timeout=60_000)
        expect(page.get_by_text("from before the change")).to_have_count(0)  # solved anew, as the project stands
        page.get_by_role("button", name="Update them").click()
        expect(page.get_by_text("since these files were made")).to_have_count(0, timeout=120_000)
        assert (folder / "results" / "roof.csv").read_text().count(",excluded,") == 5
    document["targets"][0]["lines"]["L1"]["width_m"] += 0.01
    refused: list[str] = []
    for change in ({}, {"method": "paper"}):
        (folder / "project.json").write_text(json.dumps(document | change))
        with watched(browser, pages) as page:
            page.on("response", lambda answer: refused.append(answer.url) if answer.status >= 400 else None)
            page.goto(f"{pages}/track")
            expect(page.get_by_role("button", name="Start", exact=True)).to_be_visible()
            page.goto(f"{pages}/export")
            expect(page.get_by_role("status").filter(has_text="from before the change")).to_be_visible()
            expect(page.get_by_role("link", name="Go to Track")).to_be_visible()
            expect(page.locator(".export-overlay .plot-legend")).to_contain_text("P1")
            expect(page.locator(".comparison tbody tr").first).to_contain_text("East")
            expect(page.get_by_role("alert")).to_have_count(0)
    assert refused == []  # what is not there yet is a state, not an error
