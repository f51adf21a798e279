"""The page as it leaves the server: headers, escaping, static files."""

import re
from collections.abc import Iterator

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.dashboard import page


@pytest.fixture
def client() -> Iterator[TestClient]:
    app = FastAPI()
    app.include_router(page.router)
    with TestClient(app) as client:
        yield client


def test_the_page_is_sent_with_strict_headers(client: TestClient) -> None:
    answer = client.get("/dashboard")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy == {
        "default-src": "'none'", "script-src": "'self'", "style-src": "'self'", "connect-src": "'self'",
        "img-src": "'self' data:", "form-action": "'none'", "frame-ancestors": "'none'", "base-uri": "'none'",
    }  # fmt: skip
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"


def test_the_page_has_no_inline_script_or_style_and_names_no_other_host(client: TestClient) -> None:
    html = client.get("/dashboard").text
    assert re.findall(r"<script\b[^>]*>([^<]*)</script>", html) == [""]
    assert not re.search(r"<style|\sstyle=|\son[a-z]+=|javascript:", html)
    addresses = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert len(addresses) >= 3
    assert all(address.startswith(("dashboard/static/", "data:image/svg+xml", "#")) for address in addresses)


def test_the_template_escapes_what_it_is_given() -> None:
    html = page.render_page('<script>alert("1")</script>')
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html


def test_every_static_file_is_kept_under_its_own_version_only(client: TestClient) -> None:
    for name in page.static_files():
        own = client.get(f"/dashboard/static/{page.static_version()}/{name}")
        assert own.status_code == 200
        assert "immutable" in own.headers["cache-control"]
        assert own.headers["x-content-type-options"] == "nosniff"
        assert own.headers["content-type"] == page.MEDIA_TYPES["." + name.rsplit(".", 1)[1]]
        assert client.get(f"/dashboard/static/0123/{name}").headers["cache-control"] == "no-store"


@pytest.mark.parametrize("name", ["page.py", "..%2fpage.py", "%2e%2e/page.py", "", "dashboard.js%00"])
def test_no_other_file_is_served(client: TestClient, name: str) -> None:
    assert client.get(f"/dashboard/static/{page.static_version()}/{name}").status_code == 404
