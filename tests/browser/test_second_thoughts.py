"""What a person expects of the pages besides their work: no surprise after a slip, a second thought, another look."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.browser.live import watched
from tests.browser.steps import ready


def test_messages_add_no_scrollbar(browser, project):
    _, pages = project
    with watched(browser, pages) as page:
        page.goto(f"{pages}/correspondences")
        ready(page, "Reference frame")
        page.evaluate("""async () => (await import("/static/js/components/toast.js")).toast("A word.")""")
        expect(page.get_by_text("A word.")).to_be_visible()
        assert page.evaluate("document.documentElement.scrollHeight") == page.evaluate("innerHeight")
