"""A real server on loopback, a real Chromium, a real small scene: what the browser tests stand on."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, Route, sync_playwright

from core.run import run_project

SAMPLE = Path(__file__).parents[2] / "sample_data" / "sample"
# The viewer's module for Gaussian splats, which no scene of ours holds, wants to make functions out of text. Its page's
# policy forbids that to everybody, since messages could then run text as script; the module's complaint is its end.
EVAL_OF_THE_VIEWER = "'unsafe-eval' is not an allowed source of script"
CHROMIUM_OPTIONS = ("--no-sandbox", "--enable-unsafe-swiftshader")  # WebGL without a graphics card
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def serving(workspace: Path, port: int) -> Iterator[str]:
    """Run `rooftrack serve` in a process of its own; yield its address without the last slash."""
    command = [sys.executable, "-m", "app.cli", "serve", str(workspace), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = server.stdout.readline().strip().rstrip("/")
            assert address.startswith("http://127.0.0.1:"), address
            yield address
        finally:
            server.send_signal(signal.SIGINT)
            try:
                server.wait(timeout=15)
            except subprocess.TimeoutExpired:
                server.kill()


@contextlib.contextmanager
def chromium() -> Iterator[Browser]:
    """The computer's own Chromium, or else the one Playwright brought."""
    path = next((found for name in CHROMIUM_NAMES if (found := shutil.which(name))), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM_OPTIONS)
        try:
            yield browser
        finally:
            browser.close()


@contextlib.contextmanager
def watched(browser: Browser, address: str, **options: Any) -> Iterator[Page]:
    """Yield a page that must neither throw, nor be answered an internal error, nor ask any other computer."""
    troubles: list[str] = []
    context: BrowserContext = browser.new_context(**{"viewport": {"width": 1440, "height": 900}, **options})
    context.set_default_timeout(45_000)
    page = context.new_page()
    # Asked to intercept only later, the browser would let some requests of that moment pass.
    page.route("**/asked-by-no-page", lambda route: route.abort())
    page.on("pageerror", lambda error: _note_error(str(error), troubles))
    page.on("request", lambda request: _note_outside(request.url, address, troubles))
    page.on("websocket", lambda socket: _note_outside(socket.url, address, troubles))
    page.on("console", lambda message: _note_error(message.text, troubles) if message.type == "error" else None)
    page.on(
        "response", lambda answer: troubles.append(f"{answer.status} {answer.url}") if answer.status >= 500 else None
    )
    try:
        yield page
    finally:
        context.close()  # a scene that a failed test leaves open would draw on and slow all tests after it
    assert troubles == []


def _note_outside(url: str, address: str, troubles: list[str]) -> None:
    asked = urlsplit(url)
    if asked.scheme not in ("data", "blob") and asked.netloc != urlsplit(address).netloc:
        troubles.append(f"asked {url}")


def _note_error(words: str, troubles: list[str]) -> None:
    # An answer that refuses something is the page's to tell; one of 500 and more is noted as such.
    if not words.startswith("Failed to load resource") and EVAL_OF_THE_VIEWER not in words:
        troubles.append(f"said {words}")


def shared_folder(factory: pytest.TempPathFactory) -> Path:
    """A folder of this session that all its test processes see."""
    own = factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


def measured_sample(shared: Path) -> Path:
    """Return a copy of the shipped sample with the headless engine's results, made once a session.

    Several test processes may ask; one makes it while the others wait.
    """
    shared.mkdir(parents=True, exist_ok=True)
    folder = shared / "sample"
    with (shared / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "results" / "summary.json").exists():
            shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("results"), dirs_exist_ok=True)
            run_project(folder)
    return folder


def folder_name(request: pytest.FixtureRequest) -> str:
    """Return the name of a folder for one test alone."""
    return re.sub(r"[^a-z0-9]+", "-", request.node.name)[-40:].strip("-")


def eventually(holds: Callable[[], bool], seconds: float = 20.0) -> None:
    """Wait for what comes about by itself."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not come about in time"
        time.sleep(0.1)


def answer_first(page: Page, address: str, answer: Callable[[Route], Any]) -> None:
    """Answer the first request for an address oneself; those after it go their way.

    The route stays to the end of the page: were it taken off, the browser would end its interception, and a request
    that is under way just then is never answered.
    """
    seen: list[Route] = []

    def answer_or_pass(route: Route) -> None:
        if seen:
            route.continue_()
        else:
            seen.append(route)
            answer(route)

    page.route(address, answer_or_pass)


def hold_first(page: Page, address: str) -> list[Route]:
    """Hold the first request for an address; it will be in the list that is returned (see `arrived`)."""
    held: list[Route] = []
    answer_first(page, address, held.append)
    return held


def arrived(page: Page, held: list[Any]) -> Any:
    """Wait for what a page asks, and return it."""
    for _ in range(500):
        if held:
            return held[0]
        page.wait_for_timeout(20)  # in which the page's questions are taken
    raise AssertionError("nothing came in time")


def ask(pages: str, path: str) -> Any:
    """Return what the server answers about a project, given the address of its pages."""
    with urllib.request.urlopen(f"{pages.replace('/p/', '/api/projects/')}/{path}".rstrip("/")) as answer:
        return json.load(answer)


def edit_elsewhere(page: Page, pages: str, **changes: Any) -> None:
    """Edit the project of a page as another window would."""
    before = ask(pages, "")
    body = {"project": before["project"] | changes, "revision": before["revision"], "label": "elsewhere"}
    page.evaluate(
        """([path, body]) => fetch(path, {method: "PUT", body: JSON.stringify(body),
           headers: {"X-Rooftrack": "1", "Content-Type": "application/json"}})""",
        [pages.replace("/p/", "/api/projects/"), body],
    )


def ask_bytes(pages: str, path: str) -> bytes:
    """Return a picture the server makes of a project, given the address of its pages."""
    with urllib.request.urlopen(f"{pages.replace('/p/', '/api/projects/')}/{path}") as answer:
        return answer.read()
