"""What is looked at side by side: two pictures swiped, blended and linked, the scene in step with the player."""

from __future__ import annotations

import shutil
from io import BytesIO
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Locator, Page, expect

from app.scene3d import line_colours
from tests.browser.hands import Placement, centre_of, drawn, finger, fitted, pinch, zoomed
from tests.browser.live import arrived, ask, ask_bytes, eventually, free_port, hold_first, serving, watched
from tests.browser.steps import FRAME_SIZE, NO_DOUBLE_CLICK_MS, pane, pixels, ready, saved

# What each page shows last.
SHOWN_LAST = {
    "inputs": ".input-card[data-kind=cloud] .facts",
    "orthoimage": "iframe.scene-frame",
    "correspondences": "#fit .figures",
    "regions": "#plan [data-id='found:p1']",
    "track": ".plot-entry",
    "review?view=both": ".review-frame[data-whole=true]",
    "drift": ".warnings > *",
    "export": ".comparison tbody tr",
}
# Levels by which a line's colour in the scene may differ from the one it was given: its edges are smoothed.
ALIKE_LEVELS = 40
FAR_PX = 40
# Half of a red picture, blended over the whole orthoimage, would be seen by far more.
RED_LEVELS = 20


@pytest.fixture(scope="module")
def pages(headless, tmp_path_factory):
    """The address of the pages of the shipped sample, measured; no test changes it."""
    workspace = tmp_path_factory.mktemp("workspace")
    shutil.copytree(headless, workspace / "sample")
    with serving(workspace, free_port()) as address:
        yield f"{address}/p/sample"


def test_no_page_throws_or_asks_another_computer(browser, pages):
    with watched(browser, pages) as page:
        page.goto(pages.split("/p/")[0])
        expect(page.locator(".project-card")).to_be_visible()
        for step, shown in SHOWN_LAST.items():
            page.goto(f"{pages}/{step}")
            expect(page.locator(shown).first).to_be_visible()
            page.wait_for_timeout(300)  # what comes with it, or throws after it


def grey(picture: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture and where it is opaque."""
    decoded = np.asarray(Image.open(BytesIO(picture)).convert("RGBA"))
    return cv2.cvtColor(decoded, cv2.COLOR_RGBA2GRAY), decoded[..., 3] == 255


def as_shown(picture: np.ndarray, lies: Placement, size: tuple[int, int], box: dict[str, float]) -> np.ndarray:
    """Return a picture over an image of (width, height) as a pane shows it, window px."""
    width, height = (round(lies.scale * side) for side in size)
    small = cv2.resize(picture.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    shown = np.full((round(box["height"]), round(box["width"])), np.nan, np.float32)
    left, top = np.round(lies.corner - [box["x"], box["y"]]).astype(int)
    shown[top : top + height, left : left + width] = small[: shown.shape[0] - top, : shown.shape[1] - left]
    return shown


def test_the_frame_is_swiped_and_blended_over_the_orthoimage(browser, pages):
    grid = ask(pages, "orthoimage")["grid"]
    size = (grid["width"], grid["height"])
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Orthoimage")
        ortho = pane(page, "Orthoimage")
        lies, box = fitted(page, ortho, size), ortho.bounding_box()
        ground, opaque = grey(ask_bytes(pages, "orthoimage.png"))
        frame, _ = grey(ask_bytes(pages, "rectified.jpg?pixels=4000000"))
        ground, frame = as_shown(ground, lies, size, box), as_shown(frame, lies, size, box)
        both = as_shown(opaque, lies, size, box) == 1
        left = np.arange(ground.shape[1])[None] < ground.shape[1] // 2

        compare(page, "Swipe")
        seen = shown_like(page, ortho, frame, both & left, 0.9)
        assert likeness(seen, ground, both & left) < 0.9
        assert likeness(seen, ground, both & ~left) > 0.9 > likeness(seen, frame, both & ~left)
        compare(page, "Blend")
        seen = shown_like(page, ortho, (frame + ground) / 2, both, 0.97)
        alone = max(likeness(seen, frame, both), likeness(seen, ground, both))
        assert likeness(seen, (frame + ground) / 2, both) > alone
        for _ in range(5):
            page.keyboard.press("]")
        shown_like(page, ortho, frame, both, 0.97)
        compare(page, "Ortho")
        shown_like(page, ortho, ground, both, 0.9)


def compare(page: Page, name: str) -> None:
    """Choose how the two pictures are compared."""
    group = page.get_by_role("group", name="Compare with the orthorectified frame")
    group.get_by_role("button", name=name, exact=True).click()


def test_a_late_answer_takes_no_newer_ones_place_beside_the_pairs(browser, measured):
    _, pages = measured
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame"), ready(page, "Orthoimage")
        expect(page.locator("#fit .figures")).to_contain_text("20")
        page.evaluate(
            """() => {
              window.ghosts = new Set();
              const count = () => window.ghosts.add(document.querySelectorAll("[data-id^=ghost]").length);
              new MutationObserver(count).observe(document.querySelector("#panes"), { subtree: true, childList: true });
            }"""
        )
        late = hold_first(page, "**/transform")
        placed = fitted(page, pane(page, "Reference frame"), FRAME_SIZE)
        for share in (0.4, 0.6):  # two clicks, whose counterparts are asked for
            page.mouse.click(*np.round(placed.window(np.array(FRAME_SIZE) * share)))
            page.wait_for_timeout(NO_DOUBLE_CLICK_MS)
        route = arrived(page, late)
        page.wait_for_timeout(500)  # in which the later one could be answered
        with page.expect_response("**/transform"):
            route.continue_()
        page.wait_for_timeout(500)
        expect(page.locator("[data-id^=ghost]")).to_have_count(2)
        assert 1 not in page.evaluate("[...window.ghosts]")  # the answer from before the second click

        late = hold_first(page, "**/rectified.jpg*")
        compare(page, "Blend")
        route = arrived(page, late)
        page.get_by_role("checkbox", name="Pair 2 counts").click()
        saved(page)
        red = BytesIO()
        Image.new("RGB", Image.open(BytesIO(route.fetch().body())).size, (255, 0, 0)).save(red, "JPEG")
        page.wait_for_timeout(1500)
        route.fulfill(body=red.getvalue(), content_type="image/jpeg")
        page.wait_for_timeout(1500)
        colours = np.asarray(Image.open(BytesIO(pane(page, "Orthoimage").screenshot())).convert("RGB"), dtype=float)
        assert (colours[..., 0] - colours[..., 2]).mean() < RED_LEVELS


def shown_like(page: Page, ortho: Locator, expected: np.ndarray, where: np.ndarray, least: float) -> np.ndarray:
    """Wait until the pane shows what is expected in a part of it, and return what it shows then."""
    seen = shown_by(page, ortho)
    for _ in range(40):
        if likeness(seen, expected, where) > least:
            return seen
        page.wait_for_timeout(250)  # the frame is laid on the ground by the server
        seen = shown_by(page, ortho)
    pytest.fail(f"likeness {likeness(seen, expected, where):.3f}, expected more than {least}")


def shown_by(page: Page, ortho: Locator) -> np.ndarray:
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = ortho.bounding_box()
    left, top = round(box["x"]), round(box["y"])
    return pixels(page)[top : top + round(box["height"]), left : left + round(box["width"])]


def likeness(seen: np.ndarray, expected: np.ndarray, where: np.ndarray) -> float:
    """Return the correlation of two pictures in a part of them."""
    return float(np.corrcoef(seen[where], expected[where])[0, 1])


def test_linked_views_look_at_the_same_ground(browser, pages):
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame"), ready(page, "Orthoimage")
        before = looked_at(page, "ortho")
        zoomed(page, pane(page, "Reference frame"), FRAME_SIZE, np.array([300.0, 500.0]), 1200.0)
        page.wait_for_timeout(500)
        assert looked_at(page, "ortho") == before  # a view follows only when it is asked to
        page.keyboard.press("l")
        zoomed(page, pane(page, "Reference frame"), FRAME_SIZE, np.array([900.0, 560.0]), 1500.0)
        u, v, scale = looked_at(page, "frame")
        step_px = 40 / scale
        middle, beside = led(page, pages, "raw", "ortho", [[u, v], [u + step_px, v]])
        eventually(lambda: looked_at(page, "ortho")[:2] == pytest.approx(middle, abs=0.5))
        assert looked_at(page, "ortho")[2] == pytest.approx(40 / np.hypot(*(beside - middle)), rel=0.01)


def test_a_view_is_as_the_address_says_and_stays_when_the_other_picture_comes(browser, pages):
    with watched(browser, pages) as page:
        late = hold_first(page, "**/orthoimage.png*")
        page.goto(f"{pages}/correspondences?frame=400.0,300.0,1.500&ortho=1000.0,900.0,0.5000")
        ready(page, "Reference frame")
        route = arrived(page, late)
        assert looked_at(page, "frame") == [400.0, 300.0, 1.5]
        zoomed(page, pane(page, "Reference frame"), FRAME_SIZE, np.array([300.0, 500.0]), 1200.0)
        chosen = looked_at(page, "frame")
        route.continue_()
        ready(page, "Orthoimage")
        assert looked_at(page, "ortho") == [1000.0, 900.0, 0.5]
        assert looked_at(page, "frame") == chosen


def looked_at(page: Page, view: str) -> list[float] | None:
    """Return the middle of a pane, px of its picture, and its scale, as the address tells them."""
    page.wait_for_timeout(400)
    found = parse_qs(urlsplit(page.url).query).get(view)
    return None if found is None else [float(value) for value in found[0].split(",")]


def led(page: Page, pages: str, source: str, to: str, points: list[list[float]]) -> np.ndarray:
    """Return where the engine says that points of one picture lie in another."""
    answer = page.request.post(
        f"{pages.replace('/p/', '/api/projects/')}/transform",
        data={"from": source, "to": to, "points": points},
        headers={"X-Rooftrack": "1", "Origin": pages.split("/p/")[0]},
    )
    return np.array(answer.json()["points"])


@pytest.mark.parametrize(("width", "height"), [(960, 540), (720, 450)])  # 200 % of 1920 x 1080, and of 1440 x 900
def test_no_curve_goes_unnamed_where_letters_are_twice_as_large(browser, pages, width, height):
    cut_off = """() => [...document.querySelectorAll(".plot-title, .plot-entry")].filter((words) => {
        const [box, head] = [words, words.closest(".plot-head")].map((element) => element.getBoundingClientRect());
        const legend = words.closest(".plot-legend")?.getBoundingClientRect() ?? head;
        return words.scrollWidth > words.clientWidth || box.right > head.right + 1 || box.bottom > legend.bottom + 1;
    }).map((words) => words.textContent)"""
    with watched(browser, pages, viewport={"width": width, "height": height}) as page:
        for step in ("review", "drift", "export"):
            page.goto(f"{pages}/{step}")
            expect(page.locator(SHOWN_LAST.get(step, ".review-frame[data-whole=true]")).first).to_be_visible()
            eventually(lambda: page.evaluate(cut_off) == [])


def test_two_fingers_move_and_zoom_a_picture_and_place_nothing(browser, pages):
    with watched(browser, pages, has_touch=True) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        frame = pane(page, "Reference frame")
        before = fitted(page, frame, FRAME_SIZE)
        pairs = page.locator("#pairs tbody tr").count()
        moved_px = np.array([30.0, 20.0])
        pinch(page, frame, (80, 240), shift=tuple(moved_px))
        drawn(page, frame, 3 * before.scale)
        # What lay in the middle lies where the fingers' middle came to.
        middle = np.array([FRAME_SIZE[0] / 2, FRAME_SIZE[1] / 2]) - 0.5
        expected = Placement(3 * before.scale, before.window(middle) + moved_px - 3 * before.scale * (middle + 0.5))
        clicked = ask(pages, "")["project"]["correspondences"][0]
        at = centre_of(frame.locator(f"[data-id='pair-{clicked['id']}']"))
        np.testing.assert_allclose(at, expected.window(np.array(clicked["frame_px"])), atol=1.5)
        pinch(page, frame, (120, 120), shift=(40.0, 0.0))
        drawn(page, frame, 3 * before.scale)
        assert page.locator("#pairs tbody tr").count() == pairs
        assert len(ask(pages, "")["project"]["correspondences"]) == pairs


def test_a_finger_grabs_what_it_covers(browser, measured):
    with watched(browser, measured[1], has_touch=True) as page:
        page.goto(f"{measured[1]}/correspondences")
        ready(page, "Reference frame")
        frame = pane(page, "Reference frame")
        placed = fitted(page, frame, FRAME_SIZE)
        pair = ask(measured[1], "")["project"]["correspondences"][2]
        beside = placed.window(np.array(pair["frame_px"])) + [-20.0, 0.0]
        finger(page, beside, (-30.0, 24.0))
        saved(page)
        moved = ask(measured[1], "")["project"]["correspondences"][2]
        by_px = placed.window(np.array(moved["frame_px"])) - placed.window(np.array(pair["frame_px"]))
        np.testing.assert_allclose(by_px, [-30, 24], atol=0.6)


def test_two_fingers_zoom_a_plot_and_choose_no_frame(browser, pages):
    with watched(browser, pages, has_touch=True) as page:
        page.goto(f"{pages}/review?frame=100")
        expect(page.locator(".review-frame[data-frame='100']")).to_be_attached()
        plot = page.locator(".plot-body").first
        page.wait_for_timeout(500)
        before = plot.screenshot()
        pinch(page, plot, (60, 240))
        eventually(lambda: plot.screenshot() != before)
        assert page.url.endswith("frame=100")


def test_the_scene_follows_the_player_and_exaggerates_the_motion(browser, pages):
    history = ask(pages, "results/roof")
    peak = int(np.nanargmax(np.abs(np.array(history["p1_dx_m"], dtype=float))))
    with watched(browser, pages) as page:
        page.goto(f"{pages}/review?view=scene&frame=0")
        scene = page.frame_locator("iframe.scene-frame")
        expect(scene.locator("canvas").first).to_be_visible(timeout=60_000)
        frame_facts = page.get_by_label("This frame", exact=True)
        expect(frame_facts).to_contain_text("Rotation")
        expect(frame_facts).not_to_contain_text("Ground")  # told only of a frame that is looked at
        slider = page.get_by_role("slider", name="Exaggeration of the roof's motion")
        slider.focus()
        slider.press("End")
        expect(page.locator(".scene-bar output")).to_have_text("100×")
        at_rest = roof_line(page)
        page.evaluate(SCRUB, peak)
        moved = roof_line(page)
        assert np.hypot(*(moved - at_rest)) > FAR_PX  # a third of a metre, a hundred times
        slider.focus()
        slider.press("Home")
        assert np.hypot(*(roof_line(page) - at_rest)) < FAR_PX / 4


def test_the_scene_of_one_project_is_not_shown_as_anothers(browser, pages):
    address = pages.split("/p/")[0]
    with watched(browser, pages) as first, watched(browser, pages) as second:
        first.goto(f"{pages}/orthoimage")
        scene = first.locator("iframe.scene-frame")
        expect(first.locator("#scene-settings")).to_contain_text("drawn; the engine uses all", timeout=60_000)
        expect(scene).to_be_visible()
        inside = first.frame_locator("iframe.scene-frame")
        expect(inside.locator("[data-dock-tab=viser-control-panel]")).to_be_hidden()
        made = second.request.post(
            f"{address}/api/projects", data={"name": "empty"}, headers={"X-Rooftrack": "1", "Origin": address}
        ).json()
        second.goto(f"{address}/p/{made['id']}/orthoimage")
        expect(second.locator("#scene .pane-note")).to_contain_text("no point cloud")
        expect(second.locator("iframe.scene-frame")).to_be_hidden()
        expect(scene).to_be_hidden()
        first.get_by_role("button", name="Show this project here").click()
        expect(scene).to_be_visible()
        expect(second.locator("#scene .pane-note")).to_contain_text("“sample” in another window")


SCRUB = """(frame) => {
    const scrubber = document.querySelector(".player-scrubber");
    scrubber.value = String(frame);
    scrubber.dispatchEvent(new Event("input", { bubbles: true }));
}"""


def roof_line(page: Page) -> np.ndarray:
    """Return the middle of line L1 in the scene, window px, as soon as it has stopped moving."""
    frame = page.locator("iframe.scene-frame")
    before = None
    for _ in range(40):
        page.wait_for_timeout(800)  # the scene fades in, and follows with a little delay
        picture = np.asarray(Image.open(BytesIO(frame.screenshot())).convert("RGB"), np.int16)
        alike = np.abs(picture - line_colours()["L1"]).max(axis=2) < ALIKE_LEVELS
        alike[:, : alike.shape[1] // 3] = False  # the slider has the same blue
        rows, columns = np.nonzero(alike)
        if len(rows) > 5:
            middle = np.array([np.median(columns), np.median(rows)])
            if before is not None and np.abs(middle - before).max() < 2:
                return middle
            before = middle
    pytest.fail("the line was not seen, or never came to rest")
