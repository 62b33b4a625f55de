"""A browser, and pages that tell of every error and every request."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

import pytest

CHROMIUM = shutil.which("chromium")
Open = Callable[..., Any]


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="make test-live installs playwright")
    if CHROMIUM is None:
        pytest.skip("chromium is not on this machine: apt-get install chromium")
    with api.sync_playwright() as playwright:
        # As root chromium has no sandbox; here it opens pages of this machine alone.
        made = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield made
        made.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Open]:
    """Open pages that must have no error on the console and ask for nothing beyond this PC."""
    pages, errors, requests = [], [], []

    def opened(url: str, script: str = "", size: tuple[int, int] = (1920, 1080)) -> Any:
        """Open a page; the script is of the tests, and runs before those of the page."""
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.add_init_script(script)
        pages.append(page)
        page.on("console", lambda said: errors.append(said.text) if said.type != "log" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.on("websocket", lambda socket: requests.append(socket.url))
        page.goto(url)
        return page

    yield opened
    for page in pages:
        page.close()
    assert errors == []
    assert {urlsplit(url).hostname for url in requests} <= {"127.0.0.1", "localhost"}


@pytest.fixture
def place() -> Iterator[Path]:
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)
