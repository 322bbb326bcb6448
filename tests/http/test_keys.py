"""The API key: which routes need it, and when the service checks it."""

from collections.abc import AsyncIterator
from typing import Any

import pytest
from httpx import ASGITransport, AsyncClient

from tests.http.test_documentation import operations
from tests.http.test_problems import problem
from tests.services import client_of_service

API_KEY = "incorrect-zebra-capacitor-nail"
# Listed here too, so that a route is opened on purpose or not at all.
OPEN_OPERATIONS = {"/health/live", "/health/ready"}
SCENE = {"objects": ["bed", "lamp"]}

# A service that needs a key; the client sends none.
guarded = client_of_service(api_key=API_KEY)


@pytest.fixture(scope="module")
async def document(guarded: AsyncClient) -> Any:
    return (await guarded.get("/openapi.json")).json()


async def test_only_health_needs_no_key(guarded: AsyncClient, document: dict[str, Any]) -> None:
    schemes = document["components"]["securitySchemes"]
    assert schemes["api-key"] == {"type": "apiKey", "in": "header", "name": "X-API-Key"}
    assert schemes["api-key-as-bearer-token"] == {"type": "http", "scheme": "bearer"}
    assert len(document["paths"]) > len(OPEN_OPERATIONS)
    for method, path, operation in operations(document):
        response = await guarded.request(method, path)
        named = {name for entry in operation.get("security", ()) for name in entry}
        if path in OPEN_OPERATIONS:
            assert response.status_code == 200, path
            assert named == set()
            assert "401" not in operation["responses"]
            continue
        problem(response, 401, "unauthorized")
        assert response.headers["www-authenticate"] == "Bearer"
        assert named == schemes.keys(), path
        (content,) = operation["responses"]["401"]["content"].values()
        assert "unauthorized" in content["examples"]


# Dots are encoded, or the client would resolve them.
FOLDERS = ("/static/%2e%2e", "/docs/%2e%2e", "/problems/%2e%2e", "/static//")
PATHS = {
    200: "/ /docs /docs/swagger-ui.css /redoc /redoc/redoc.standalone.js /openapi.json "
    "/problems /problems/unauthorized /static/pages.css",
    401: "/nowhere /metrics //health/live /health/live/ /health/live/../../models /health "
    "/Health/live /models/default/vocabulary /static /docsx /openapi.json/x",
    404: "/redoc/./models "
    + " ".join(
        f"{folder}/{path}"
        for folder in FOLDERS
        for path in ("models", "relations", "models/default")
    ),
}


@pytest.mark.parametrize("status", PATHS)
async def test_only_pages_need_no_key(guarded: AsyncClient, status: int) -> None:
    for path in PATHS[status].split():
        assert (await guarded.get(path)).status_code == status, path


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"X-API-Key": ""},
        {"X-API-Key": "wrong"},
        {"X-API-Key": API_KEY[:-1]},
        {"X-API-Key": API_KEY + "x"},
        {"X-API-Key": "é".encode()},
        {"Authorization": API_KEY},
        {"Authorization": f"Basic {API_KEY}"},
        {"Authorization": "Bearer "},
        {"Cookie": f"X-API-Key={API_KEY}"},
    ],
)
async def test_other_keys_are_refused(guarded: AsyncClient, headers: Any) -> None:
    # A key in the query does not count: addresses end up in histories and in logs of proxies.
    for path in ("/relations", f"/relations?api_key={API_KEY}"):
        problem(await guarded.post(path, json=SCENE, headers=headers), 401, "unauthorized")


async def test_the_key_opens_questions(guarded: AsyncClient) -> None:
    for field in ("X-API-Key: ", "Authorization: Bearer ", "Authorization: bearer "):
        name, prefix = field.split(": ")
        headers = {name: prefix + API_KEY}
        response = await guarded.post("/relations", json=SCENE, headers=headers)
        assert response.status_code == 200
        assert (await guarded.get("/models", headers=headers)).status_code == 200


async def test_a_body_without_a_key_is_not_read(guarded: AsyncClient) -> None:
    async def body() -> AsyncIterator[bytes]:
        nonlocal read
        read = True
        yield b"{"

    read = False
    response = await guarded.post("/relations", content=body())
    problem(response, 401, "unauthorized")
    assert not read
    # The key comes before the size.
    headers = {"Content-Length": "999999999"}
    response = await guarded.post("/relations", content=b"", headers=headers)
    problem(response, 401, "unauthorized")


async def test_a_prefix_opens_no_route(guarded: AsyncClient) -> None:
    app: Any = guarded.app  # type: ignore[attr-defined]
    transport = ASGITransport(app, raise_app_exceptions=False, root_path="/robot")
    async with AsyncClient(transport=transport, base_url="http://service") as behind:
        for path, status in (("health/live", 200), ("models", 401), ("static", 401)):
            assert (await behind.get(f"/robot/{path}")).status_code == status
