"""Pages without internet, and the OpenAPI document compared with the service."""

import json
import re
from collections.abc import AsyncIterator
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import pytest
from httpx import AsyncClient, Response

from app.api.examples import REQUESTS
from app.errors import ERRORS
from scene_client import schemas
from scene_client.schemas import Problem
from tests.http.test_problems import problem
from tests.services import LiveService, defect, serve

API_KEY = "incorrect-zebra-capacitor-nail"
PAGES = ["/", "/docs", "/redoc", "/problems", "/problems/not-json"]
# Digest of app/static/vendor, so that a change of a library's file is seen.
LIBRARIES = "a4252c50f31707e177320a71048b678dc5a20d9d0909694ee37cf104f267486e"

INLINE = r"""(?s)<(script|style)[^>]*>\s*[^\s<]|<[^>]*\s(on\w+|style)\s*="""
"""A script, a style sheet, a handler of events or a style in a page."""


@pytest.mark.parametrize("page", PAGES)
async def test_pages_load_only_from_the_service(client: AsyncClient, page: str) -> None:
    response = await client.get(page)
    assert response.status_code == 200
    check(response)
    policy = response.headers["content-security-policy"]
    directives = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert (directives["default-src"], directives["script-src"]) == ("'none'", "'self'")
    assert not re.search(r"https?:|\*", policy)
    assert page != "/" or "unsafe" not in policy
    assert not re.search(INLINE, response.text)
    links = re.findall(r'\s(?:src|href)="([^"]+)"', response.text)
    assert len(links) >= 2
    for link in links:
        assert not link.startswith("/"), "pages work behind a prefix"
        address = urljoin(f"http://service{page}", link)
        assert urlsplit(address).netloc == "service"
        assert (await client.get(address)).status_code == 200, link


async def test_pages_can_be_switched_off(shared_store: Path) -> None:
    async with serve(shared_store, docs=False) as client:
        for page in ("/docs", "/redoc", "/", "/docs/swagger-ui.css", "/openapi.json"):
            assert (await client.get(page)).status_code == 404
        assert (await client.get("/problems/not-json")).status_code == 200


async def test_only_libraries_are_cached(client: AsyncClient) -> None:
    page = await client.get("/")
    assert page.headers["cache-control"] == "no-cache"
    again = await client.get("/", headers={"If-None-Match": page.headers["etag"]})
    assert again.status_code == 304
    assert again.headers["content-security-policy"] == page.headers["content-security-policy"]
    module = await client.get("/static/board/main.js")
    assert module.headers["cache-control"] == "no-cache"
    assert module.headers["content-type"].startswith("text/javascript")
    library = await client.get("/static/vendor/d3-drag-3.0.1/d3-drag.min.js")
    assert "immutable" in library.headers["cache-control"]


def test_libraries_are_unchanged(repository: Path) -> None:
    """The sha256 of what `sha256sum` prints of their files, each beside its licence."""
    folder = repository / "app" / "static" / "vendor"
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    assert [path.name for path in files].count("LICENSE") == len(files) / 2 == 3
    digests = ((sha256(path.read_bytes()).hexdigest(), path.relative_to(folder)) for path in files)
    text = "".join(f"{digest}  {path}\n" for digest, path in digests)
    assert sha256(text.encode()).hexdigest() == LIBRARIES


@pytest.fixture(scope="module")
async def client(
    shared_store: Path, tmp_path_factory: pytest.TempPathFactory, anyio_backend: str
) -> AsyncIterator[AsyncClient]:
    """A client of a service with all routes."""
    recording = tmp_path_factory.mktemp("recording") / "scenes.jsonl"
    async with serve(shared_store, api_key=API_KEY, recording=recording) as client:
        client.headers["X-API-Key"] = API_KEY
        yield client


@pytest.fixture
async def document(client: AsyncClient) -> Any:
    return (await client.get("/openapi.json")).json()


def operations(document: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        (method, path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


def inlined(part: Any, document: dict[str, Any]) -> Any:
    """Return a part of the document, with the component in place of each reference."""
    if isinstance(part, list):
        return [inlined(one, document) for one in part]
    if not isinstance(part, dict):
        return part
    if "$ref" in part:
        _, _, kind, name = part["$ref"].split("/")
        beside = {key: value for key, value in part.items() if key != "$ref"}
        part = document["components"][kind][name] | beside
    return {key: inlined(value, document) for key, value in part.items()}


def arrays(part: Any) -> list[dict[str, Any]]:
    """Return the schemas of arrays in a part of a document."""
    if not isinstance(part, dict | list):
        return []
    parts = part if isinstance(part, list) else part.values()
    inner = [schema for one in parts for schema in arrays(one)]
    is_array = isinstance(part, dict) and part.get("type") == "array"
    return [part, *inner] if is_array else inner


async def test_the_document_is_small(client: AsyncClient) -> None:
    assert len((await client.get("/openapi.json")).content) <= 150_000


async def test_every_array_has_items(document: dict[str, Any]) -> None:
    models = [
        model.model_json_schema()
        for model in vars(schemas).values()
        if isinstance(model, type) and issubclass(model, schemas.Request | schemas.Reply)
    ]
    for part in (document, models):
        found = arrays(part)
        assert len(found) > 50
        for schema in found:
            assert "items" in schema
            assert "prefixItems" not in schema


async def test_errors_are_problems(document: dict[str, Any]) -> None:
    documented = set()
    assert not {"HTTPValidationError", "ValidationError"} & set(document["components"]["schemas"])
    for method, path, operation in operations(document):
        responses = inlined(operation["responses"], document)
        errors = {status: response for status, response in responses.items() if status[0] in "45"}
        assert "500" in errors, path
        if method in {"post", "put"} and "requestBody" in operation:
            assert {"400", "413", "415", "422", "503"} <= set(errors), path
        for status, response in errors.items():
            (media_type,) = response["content"]
            assert media_type == "application/problem+json"
            for slug, example in response["content"][media_type]["examples"].items():
                described = Problem.model_validate(example["value"], extra="forbid")
                assert str(described.status) == status
                documented.add(slug)
    # A route lists each error, unless only Starlette or a check of the origin raises it.
    assert documented == {slug for slug, kind in ERRORS.items() if {*kind.steps} - {"http"}}


def model_of(content: dict[str, Any]) -> Any:
    """The model that a media type's schema describes."""
    outer, _, inner = content["schema"]["$ref"].rpartition("/")[2].partition("_")
    model = getattr(schemas, outer)
    return model[getattr(schemas, inner.rstrip("_"))] if inner else model


QUESTIONS = [(operation, name) for operation, cases in REQUESTS.items() for name in cases]


@pytest.mark.parametrize(("operation", "name"), QUESTIONS)
async def test_examples_are_answered_as_documented(client, document, operation, name):
    case = REQUESTS[operation][name]
    address = "/" + operation.replace("_", "/")
    response = await client.post(address, json=case.value)
    responses = document["paths"][address]["post"]["responses"]
    if case.problem is None:
        assert response.status_code == 200, response.text
        # No field too many or in another place, and every number as it was.
        model = model_of(responses["200"]["content"]["application/json"])
        validated = model.model_validate_json(response.content, extra="forbid")
        assert validated.model_dump_json(exclude_unset=True) == response.text
        return
    found = problem(response, ERRORS[case.problem].status, case.problem)
    documented = inlined(responses[str(response.status_code)], document)
    shown = documented["content"]["application/problem+json"]["examples"][case.problem]
    if name in {"unknown-labels", "contradictory-evidence"}:
        # The problem in the document is the one that this example meets.
        assert shown["value"]["errors"] == found["errors"]


async def test_example_answers_have_the_fields_of_real_ones(document: dict[str, Any]) -> None:
    for _, path, operation in operations(document):
        ((media_type, ok),) = operation["responses"]["200"]["content"].items()
        if media_type == "text/plain":
            assert path == "/metrics"  # its example is compared in test_monitoring
            continue
        validated = model_of(ok).model_validate(ok["example"], extra="forbid")
        dumped = json.loads(validated.model_dump_json(exclude_none=True))
        assert dumped == ok["example"], path


NOTHING = "default-src 'none'; frame-ancestors 'none'"
COMPUTED = [
    ("POST", "/relations", {"objects": ["bed"]}),
    ("POST", "/missing/batch", {"scenes": [{"objects": ["bed"]}]}),
    ("POST", "/missing", {"objects": ["bed"]}),  # status 500
    ("GET", "/models", None),
    ("GET", "/models/default/vocabulary", None),
    ("GET", "/health/live", None),
    ("GET", "/openapi.json", None),
    ("POST", "/relations", {"objects": []}),
    ("GET", "/nowhere", None),
    ("GET", "/static/nowhere", None),
    ("DELETE", "/relations", None),
]


def check(response: Response) -> None:
    """Check the headers that every answer has."""
    assert response.headers["x-content-type-options"] == "nosniff"
    assert response.headers["referrer-policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in response.headers["content-security-policy"]
    assert "server" not in response.headers
    assert "x-powered-by" not in response.headers
    # One of each: a browser joins two policies, and two cache rules contradict each other.
    names = [name for name, _ in response.headers.raw]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(("method", "path", "body"), COMPUTED)
async def test_computed_answers_are_not_cached(client, replace, method, path, body):
    replace("missing", defect)
    response = await client.request(method, path, json=body)
    check(response)
    assert response.headers["cache-control"] == "no-store"
    assert response.headers["content-security-policy"] == NOTHING


@pytest.mark.system
def test_the_server_does_not_name_itself(live: LiveService) -> None:
    for path in ("health/live", "docs", "nowhere", "static/pages.css", "docs/swagger-ui-bundle.js"):
        check(live.client.get(f"/{path}"))
