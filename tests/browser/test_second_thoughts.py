"""What a person expects of the pages besides their work: no surprise after a slip, a second thought, another look."""

from __future__ import annotations

import numpy as np
from playwright.sync_api import Page, expect

from core.project import read_project
from tests.browser.hands import fitted
from tests.browser.live import watched
from tests.browser.steps import FRAME_SIZE, pane, ready, saved


def test_messages_add_no_scrollbar(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.evaluate("""async () => (await import("/static/js/components/toast.js")).toast("A word.")""")
        expect(page.get_by_text("A word.")).to_be_visible()
        assert page.evaluate("document.documentElement.scrollHeight") == page.evaluate("innerHeight")


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
