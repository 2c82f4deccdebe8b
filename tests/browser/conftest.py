"""One browser for all tests here: each test opens windows of its own in it."""

from __future__ import annotations

import pytest

from tests.browser.live import chromium


@pytest.fixture(scope="session")
def browser():
    with chromium() as found:
        yield found
