"""GET /dashboard and its static files. The page holds no data: its script asks the JSON API of the same origin."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

from fastapi import APIRouter, HTTPException, Response
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined

FOLDER = Path(__file__).parent
MEDIA_TYPES = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8"}
POLL_SECONDS = 2.0
ONE_YEAR = "public, max-age=31536000, immutable"
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
)
PAGE_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}

router = APIRouter(include_in_schema=False)


@cache
def static_files() -> dict[str, bytes]:
    """Every static file by name. They are few and small, and a fixed table leaves no path to climb out of."""
    return {
        path.name: path.read_bytes() for path in sorted((FOLDER / "static").iterdir()) if path.suffix in MEDIA_TYPES
    }


@cache
def static_version() -> str:
    """Hash over all static files. It stands in their path, so that modules that import each other carry it along."""
    digest = hashlib.sha256()
    for name, content in static_files().items():
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:16]


@cache
def templates() -> Environment:
    """The template environment; autoescape is on for every template, whatever its suffix."""
    return Environment(loader=FileSystemLoader(FOLDER / "templates"), autoescape=True, undefined=StrictUndefined)


def render_page(product_version: str) -> str:
    """HTML of the page."""
    page = templates().get_template("dashboard.html")
    return page.render(
        static=f"dashboard/static/{static_version()}", product_version=product_version, poll_seconds=POLL_SECONDS
    )


@router.get("/dashboard", response_class=HTMLResponse)
def dashboard() -> HTMLResponse:
    """The page, the same for everyone: what it shows depends on the API's answers to its reader."""
    return HTMLResponse(render_page(version("asim")), headers=PAGE_HEADERS)


@router.get("/dashboard/static/{requested_version}/{name}")
def static_file(requested_version: str, name: str) -> Response:
    """One static file. Kept for a year under its own version, not at all under another one (a rolling upgrade).

    Raises HTTPException 404 for a name that is not one of `static_files`.
    """
    content = static_files().get(name)
    if content is None:
        raise HTTPException(status_code=404, detail=f"name: there is no static file {name!r}")
    caching = ONE_YEAR if requested_version == static_version() else "no-store"
    headers = {"Cache-Control": caching, "X-Content-Type-Options": "nosniff"}
    return Response(content, media_type=MEDIA_TYPES[Path(name).suffix], headers=headers)
