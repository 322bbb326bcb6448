"""The pages work without internet, and the OpenAPI document tells the truth."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import httpx
import pytest

from app import schemas
from app.schemas import Problem
from tests.http.conftest import serve

pytestmark = pytest.mark.anyio

PAGES = ["/docs", "/redoc", "/problems", "/problems/not-json"]


class Links(HTMLParser):
    """What a page loads or links to, and whether it has script or style of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.inline: list[str] = []
        self._inside = ""

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        known = dict(attributes)
        self.links += [value for name in ("src", "href") if (value := known.get(name))]
        self.inline += [name for name in known if name.startswith("on") or name == "style"]
        self._inside = tag

    def handle_data(self, data: str) -> None:
        if self._inside in {"script", "style"} and data.strip():
            self.inline.append(data)


@pytest.mark.parametrize("page", PAGES)
async def test_pages_load_from_the_service_alone(client: httpx.AsyncClient, page: str) -> None:
    response = await client.get(page)
    assert response.status_code == 200
    parser = Links()
    parser.feed(response.text)
    assert parser.inline == []
    assert len(parser.links) >= 2
    for link in parser.links:
        address = urljoin(f"http://service{page}", link)
        assert urlsplit(address).netloc == "service"
        assert (await client.get(address)).status_code == 200, link


@pytest.mark.parametrize("page", PAGES)
async def test_pages_forbid_everything_from_elsewhere(client: httpx.AsyncClient, page: str) -> None:
    policy = (await client.get(page)).headers["content-security-policy"]
    directives = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert directives["default-src"] == "'none'"
    assert directives["script-src"] == "'self'"
    assert not re.search(r"https?:|\*", policy)


async def test_scripts_load_nothing_from_elsewhere(client: httpx.AsyncClient) -> None:
    # Redoc's bundle shows a logo: from beside it, not from the network of its maker.
    bundle = (await client.get("/redoc/redoc.standalone.js")).text
    assert not re.search(r"src:\s*\"https?://", bundle)
    assert (await client.get("/redoc/logo-mini.svg")).status_code == 200
    for script in ("/static/docs.js", "/static/redoc.js"):
        assert "http" not in (await client.get(script)).text


async def test_pages_work_behind_a_prefix(client: httpx.AsyncClient) -> None:
    for page in PAGES:
        assert not re.search(r'(src|href)="/', (await client.get(page)).text)


async def test_pages_can_be_switched_off(shared_store: Path) -> None:
    async with serve(shared_store, docs=False) as client:
        for page in ("/docs", "/redoc", "/", "/docs/swagger-ui.css"):
            assert (await client.get(page)).status_code == 404
        assert (await client.get("/openapi.json")).status_code == 200
        assert (await client.get("/problems/not-json")).status_code == 200


async def test_the_root_leads_to_the_documentation(client: httpx.AsyncClient) -> None:
    response = await client.get("/")
    assert response.status_code == 307
    assert response.headers["location"] == "docs"


# ------------------------------------------------------------------------------------ OpenAPI


@pytest.fixture
async def document(client: httpx.AsyncClient) -> dict[str, Any]:
    document: dict[str, Any] = (await client.get("/openapi.json")).json()
    return document


def operations(document: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        (method, path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


async def test_operations_have_stable_distinct_ids(document: dict[str, Any]) -> None:
    names = [operation["operationId"] for _, _, operation in operations(document)]
    assert len(set(names)) == len(names)
    assert {"relations", "missing", "outliers", "generate", "relations_batch"} <= set(names)
    assert {"refresh_models", "move_alias", "health_ready", "show_vocabulary"} <= set(names)
    assert all(re.fullmatch(r"[a-z_]+", name) for name in names)


async def test_every_operation_is_described(document: dict[str, Any]) -> None:
    tags = {tag["name"] for tag in document["tags"]}
    for _, path, operation in operations(document):
        assert operation["summary"], path
        assert operation["description"], path
        assert set(operation["tags"]) <= tags
        assert len(operation["tags"]) == 1


async def test_every_reference_resolves(document: dict[str, Any]) -> None:
    def references(node: Any) -> list[str]:
        if isinstance(node, dict):
            own = [node["$ref"]] if isinstance(node.get("$ref"), str) else []
            return own + [found for value in node.values() for found in references(value)]
        if isinstance(node, list):
            return [found for value in node for found in references(value)]
        return []

    known = {f"#/components/schemas/{name}" for name in document["components"]["schemas"]}
    found = set(references(document))
    assert "#/components/schemas/Problem" in found
    assert found <= known


async def test_errors_are_problems_and_nothing_else(document: dict[str, Any]) -> None:
    assert not {"HTTPValidationError", "ValidationError"} & set(document["components"]["schemas"])
    for method, path, operation in operations(document):
        errors = {s: r for s, r in operation["responses"].items() if s[0] in "45"}
        assert "500" in errors, path
        if method in {"post", "put"} and "requestBody" in operation:
            assert {"400", "413", "415", "422", "503"} <= set(errors), path
        if "administration" in operation["tags"]:
            assert "401" in errors
            assert operation["security"]
        for status, response in errors.items():
            (media_type,) = response["content"]
            assert media_type == "application/problem+json"
            for example in response["content"][media_type]["examples"].values():
                described = Problem.model_validate(example["value"], extra="forbid")
                assert str(described.status) == status


async def test_every_question_has_worked_examples(
    client: httpx.AsyncClient, document: dict[str, Any]
) -> None:
    components = document["components"]["schemas"]
    for method, path, operation in operations(document):
        (ok,) = operation["responses"]["200"]["content"].values()
        assert "example" in ok, path
        if "requestBody" not in operation:
            continue
        schema = operation["requestBody"]["content"]["application/json"]["schema"]
        examples = schema.get("examples")
        if examples is None:
            examples = components[schema["$ref"].rpartition("/")[2]]["examples"]
        assert examples, path
        if "administration" in operation["tags"]:
            continue
        for example in examples:
            response = await client.request(method, path, json=example)
            assert response.status_code == 200, (path, response.text)


async def test_example_answers_have_the_fields_of_real_ones(document: dict[str, Any]) -> None:
    for _, path, operation in operations(document):
        ((media_type, ok),) = operation["responses"]["200"]["content"].items()
        if media_type == "text/plain":
            assert path == "/metrics"  # its example is compared in test_monitoring
            continue
        outer, _, inner = ok["schema"]["$ref"].rpartition("/")[2].partition("_")
        model = getattr(schemas, outer)
        if inner:
            model = model[getattr(schemas, inner.rstrip("_"))]
        validated = model.model_validate(ok["example"], extra="forbid")
        dumped = json.loads(validated.model_dump_json(exclude_none=True))
        assert dumped == ok["example"], path
