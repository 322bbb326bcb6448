"""HTML pages: the scene editor (board), the API documentation and a page for each problem type.

Their Content-Security-Policy lets a browser load files only from this service.
"""

from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Final

from fastapi import APIRouter, FastAPI
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from app.errors import ERRORS, NotFoundError

STATIC: Final = Path(__file__).parents[1] / "static"

# Policy of the scene editor (board.html).
_STRICT_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Policy of the API documentation. Swagger UI and Redoc need inline styles. Redoc searches in a web
# worker, which Redoc creates from a blob. Both policies forbid inline scripts.
_POLICY: Final = (
    _STRICT_POLICY.replace("style-src 'self'", "style-src 'self' 'unsafe-inline'")
    + "; font-src 'self' data:; worker-src blob:"
)
_HEADERS: Final = {"Content-Security-Policy": _POLICY}

_PAGE: Final = """<!doctype html>
<html lang="en">
  <head>
    <meta charset="utf-8">
    <meta name="viewport" content="width=device-width, initial-scale=1">
    <title>{title}</title>
    <link rel="icon" href="{root}static/icon.svg" type="image/svg+xml">
    <link rel="stylesheet" href="{root}static/pages.css">
  </head>
  <body>
    <h1>{title}</h1>
    {body}
  </body>
</html>
"""

problems = APIRouter(include_in_schema=False)


def _page(title: str, body: str, *, root: str) -> HTMLResponse:
    return HTMLResponse(_PAGE.format(title=escape(title), body=body, root=root), headers=_HEADERS)


@problems.get("/problems")
async def list_problem_types() -> HTMLResponse:
    """Return the HTML page with links to the pages of all problem types."""
    entries = "\n".join(
        f'<dt><a href="problems/{kind.slug}"><code>{kind.slug}</code></a> ({kind.status})</dt>'
        f"<dd>{escape(kind.title)}</dd>"
        for kind in ERRORS.values()
    )
    return _page("Problems", f"<dl>{entries}</dl>", root="")


@problems.get("/problems/{slug}")
async def show_problem_type(slug: str) -> HTMLResponse:
    """Return the HTML page with the cause and the remedy of a problem type."""
    kind = ERRORS.get(slug)
    if kind is None:
        raise NotFoundError("No problem type has this name.")
    body = (
        f"<p><code>{kind.uri}</code>, status {kind.status}</p><p>{escape(kind.explanation)}</p>"
        '<p><a href="../problems">All problems</a></p>'
    )
    return _page(kind.title, body, root="../")


class Assets(StaticFiles):
    """Static files with entity tags (the header ETag).

    Browsers may cache vendored libraries for a year, because their folders name the version.
    """

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, or status 304 if the browser has the current version of the file."""
        response = await super().get_response(path, scope)
        if response.status_code in {200, 304}:
            # With "no-cache", a browser checks each file for a newer version. Otherwise the browser
            # could mix JavaScript modules of two releases.
            immutable = path.startswith("vendor/")
            policy = "public, max-age=31536000, immutable" if immutable else "no-cache"
            response.headers["Cache-Control"] = policy
        return response


def install(app: FastAPI, *, docs: bool) -> None:
    """Serve the HTML pages and their assets. If ``docs`` is False, omit /, /docs and /redoc."""
    app.include_router(problems)
    static = Assets(directory=STATIC)
    app.mount("/static", static, name="static")
    if not docs:
        return
    assets = Path(str(files("fastapi_standalone_docs"))) / "static"
    for name, folder in (("docs", "swagger"), ("redoc", "redoc")):
        _serve_document(app, f"/{name}", (STATIC / f"{name}.html").read_text(encoding="utf-8"))
        app.mount(f"/{name}", StaticFiles(directory=assets / folder), name=f"{name} assets")

    @app.get("/", include_in_schema=False)
    async def board(request: Request) -> Response:
        response = await static.get_response("board.html", request.scope)
        response.headers["Content-Security-Policy"] = _STRICT_POLICY
        return response


def _serve_document(app: FastAPI, path: str, html: str) -> None:
    @app.get(path, include_in_schema=False)
    async def document() -> HTMLResponse:
        return HTMLResponse(html, headers=_HEADERS)
