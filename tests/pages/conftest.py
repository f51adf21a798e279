"""A headless browser, and a page that fails its test on any console error or request to another host."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from fastapi import FastAPI
from playwright.sync_api import Browser, ConsoleMessage, Dialog, Page, Request, sync_playwright

from service.dashboard import page as dashboard_page
from tests.pages.canned_api import CannedApi, application, serving

ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    path = shutil.which("chromium")
    if path is None:
        message = "chromium is not installed: apt-get install chromium"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


@dataclass
class Site:
    """The canned service and where it listens.

    noise: what the browser complained about. expected: parts of the complaints that a test causes on purpose; the
    browser logs every failed request by itself, and may do so late.
    """

    api: CannedApi
    app: FastAPI
    port: int
    noise: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> CannedApi:
    monkeypatch.setattr(dashboard_page, "POLL_SECONDS", 0.2)
    return CannedApi()


@pytest.fixture
def site(api: CannedApi) -> Iterator[Site]:
    app = application(api)
    with serving(app) as port:
        yield Site(api, app, port)


@pytest.fixture
def page(browser: Browser, site: Site) -> Iterator[Page]:
    """A fresh page; at the end nothing was logged as an error, no dialog came up, no other host was asked."""
    context = browser.new_context()
    context.set_default_timeout(6000)
    page = context.new_page()

    def console(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            site.noise.append(f"console: {message.text}")

    def dialog(box: Dialog) -> None:
        site.noise.append(f"dialog: {box.message}")
        box.dismiss()

    def asked(request: Request) -> None:
        if not request.url.startswith(("http://127.0.0.1:", "data:")):
            site.noise.append(f"other host: {request.url}")

    page.on("console", console)
    page.on("dialog", dialog)
    page.on("request", asked)
    page.on("pageerror", lambda error: site.noise.append(f"exception: {error}"))
    yield page
    context.close()
    assert [each for each in site.noise if not any(part in each for part in site.expected)] == []
