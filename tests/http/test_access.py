"""Who may ask: host names, origins and the API key. The log has no keys and no payloads."""

import re
import socket
from collections.abc import AsyncIterator
from contextlib import suppress
from itertools import product
from pathlib import Path
from socket import gethostname
from typing import Any

import pytest
from httpx import ASGITransport, AsyncClient, Response

from app.api.gateway import HEALTH
from app.settings import Settings
from tests.http.test_documentation import inlined, operations
from tests.http.test_problems import problem
from tests.services import (
    DEFECTIVE,
    PATIENCE,
    LiveService,
    Replace,
    client_of_service,
    defect,
    launch,
    serve,
)

API_KEY = "incorrect-zebra-capacitor-nail"
SCENE = {"objects": ["bed"]}
LOCAL = {"localhost", "pc-7.lab", "pc-7.local"}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, {*LOCAL, "127.0.0.1"}),
        ({"host": "[FD00::7]"}, {*LOCAL, "fd00::7"}),
        ({"host": "Robot.local"}, {*LOCAL, "robot.local"}),
        ({"allowed_hosts": "scene, Robot.local [fd00::7]"}, {"scene", "robot.local", "fd00::7"}),
        ({"allowed_hosts": "scene,*"}, None),
    ],
)
def test_accepted_hosts(tmp_path, monkeypatch, settings, expected):
    monkeypatch.setattr("app.settings.gethostname", lambda: "PC-7.lab")
    assert Settings(store=tmp_path, **settings).accepted_hosts == expected


async def test_requests_for_another_host_are_refused(shared_store: Path) -> None:
    addresses = ("127.0.0.1", "192.168.1.20:8000", "[::1]:8000", "[FD00::7]")
    accepted = (*addresses, "LOCALHOST:1", f"{gethostname()}:8000")
    others = ("evil.example", "127.0.0.1.evil.example", "localhost@evil.example", "1.2.3.4.5")
    malformed = ("localhost:80:80", "localhost:port", "::1", "[::1", "1.2.3", "")
    async with serve(shared_store, allowed_hosts=()) as client:
        for host in (*accepted, *others, *malformed):
            headers = {"Host": host}
            response = await client.post("/relations", json=SCENE, headers=headers)
            if host in accepted:
                assert response.status_code == 200, host
            else:
                document = problem(response, 421, "host-refused")
                assert "SCENE_ALLOWED_HOSTS (docs/network.md)" in document["detail"]
            # Orchestrators ask by the address of a replica.
            for path in ("/health/live", "/health/ready"):
                assert (await client.get(path, headers=headers)).status_code == 200
        twice = [("Host", "localhost"), ("Host", "localhost")]
        problem(await client.get("/models", headers=twice), 421, "host-refused")


async def test_only_health_checks_accept_every_host(shared_store: Path) -> None:
    """A path is matched whole: no route below another one becomes a health check."""
    async with serve(shared_store) as client:
        paths = client.app.state.paths  # type: ignore[attr-defined]
        assert set(HEALTH) <= paths
        # The words of a vocabulary may contain slashes.
        words = {f"/models/default/vocabulary/x{path}" for path in HEALTH}
        nested = {f"{path}{check}" for path in paths if path != "/" for check in HEALTH}
        for template in paths | words | nested:
            path = re.sub(r"{\w+(:path)?}", "default", template)
            for method in ("GET", "POST"):
                response = await client.request(method, path, headers={"Host": "evil.example"})
                if path in HEALTH:
                    assert response.status_code in (200, 405)
                else:
                    problem(response, 421, "host-refused")
        for word in words:
            assert (await client.get(word)).status_code in (200, 404)


async def test_a_prefix_in_the_path_names_its_setting(client: AsyncClient) -> None:
    document = problem(await client.post("/scene/missing", json=SCENE), 404, "not-found")
    assert "SCENE_ROOT_PATH" in document["detail"]


LISTED, SECOND, OTHER = "https://panel.example", "http://10.0.0.7:8080", "https://other.example"

shared = client_of_service(cors_origins=[LISTED, SECOND], max_body_bytes=2048)


async def preflight(
    client: AsyncClient, origin: str, method: str = "POST", headers: str = "content-type"
) -> Response:
    fields = {
        "Origin": origin,
        "Access-Control-Request-Method": method,
        "Access-Control-Request-Headers": headers,
    }
    return await client.options("/relations", headers=fields)


def allowed(response: Response, origin: str) -> None:
    assert response.headers["access-control-allow-origin"] == origin
    assert "access-control-allow-credentials" not in response.headers
    assert "Origin" in response.headers["vary"]


async def test_by_default_no_origin_is_allowed(client: AsyncClient) -> None:
    problem(await preflight(client, LISTED), 405, "method-not-allowed")
    response = await client.post("/relations", json=SCENE, headers={"Origin": LISTED})
    assert response.status_code == 200
    assert not [name for name in response.headers if name.startswith("access-control")]


async def test_only_listed_origins_ask_and_read_answers(shared: AsyncClient) -> None:
    for origin in (LISTED, SECOND):
        response = await shared.post("/relations", json=SCENE, headers={"Origin": origin})
        assert response.status_code == 200
        allowed(response, origin)
        exposed = response.headers["access-control-expose-headers"].split(", ")
        assert set(exposed) == {"X-Request-Id", "Retry-After"}
        for headers in ("content-type, x-api-key", "authorization, x-request-id"):
            response = await preflight(shared, origin, headers=headers)
            assert response.status_code == 200
            allowed(response, origin)
            assert response.headers["x-request-id"]
            assert response.headers["cache-control"] == "no-store"
    response = await shared.post("/relations", json=SCENE, headers={"Origin": OTHER})
    assert "access-control-allow-origin" not in response.headers
    assert "Origin" in response.headers["vary"]


@pytest.mark.parametrize(
    ("origin", "method", "headers"),
    [
        (OTHER, "POST", "content-type"),
        ("null", "POST", "content-type"),
        (LISTED + ".other.example", "POST", "content-type"),
        (LISTED, "PUT", "content-type"),
        (LISTED, "DELETE", "content-type"),
        (LISTED, "POST", "x-anything"),
    ],
)
async def test_other_preflight_requests_are_refused(shared, origin, method, headers):
    response = await preflight(shared, origin, method, headers)
    assert response.status_code == 400
    # After a status other than 2xx, a browser goes no further.
    assert origin == LISTED or "access-control-allow-origin" not in response.headers
    assert "Origin" in response.headers["vary"]


async def test_errors_can_be_read_too(shared: AsyncClient, replace: Replace) -> None:
    replace("missing", defect)
    origin = {"Origin": LISTED}
    media = origin | {"Content-Type": "application/json"}
    for status, response in (
        (400, await shared.post("/relations", content=b"{", headers=media)),
        (404, await shared.get("/nowhere", headers=origin)),
        (405, await shared.get("/relations", headers=origin)),
        (413, await shared.post("/relations", content=b" " * 4096, headers=media)),
        (415, await shared.post("/relations", content=b"{}", headers=origin)),
        (422, await shared.post("/relations", json={}, headers=origin)),
        (500, await shared.post("/missing", json=SCENE, headers=origin)),
    ):
        assert response.status_code == status
        allowed(response, LISTED)
        assert response.json()["request_id"] == response.headers["x-request-id"]


async def test_preflight_requests_need_no_key(shared_store: Path) -> None:
    async with serve(shared_store, cors_origins=[LISTED], api_key=API_KEY) as client:
        assert (await preflight(client, LISTED)).status_code == 200
        response = await client.post("/relations", json=SCENE, headers={"Origin": LISTED})
        problem(response, 401, "unauthorized")
        allowed(response, LISTED)


# Listed here too, so that a route is opened on purpose or not at all.
OPEN_OPERATIONS = {"/health/live", "/health/ready"}

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
        (content,) = inlined(operation["responses"]["401"], document)["content"].values()
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


# What a client sends by mistake is a secret too, if perhaps of another service.
MISTAKEN = "mistaken-walrus-umbrella-fork"
SECRETS = (API_KEY, MISTAKEN)
ROOM = {"room_type": "bedroom"}

# The message of the error quotes a key.
PROGRAM = ("-c", DEFECTIVE.format(message=f"no class for {API_KEY}"))
SETTINGS = {"SCENE_API_KEY": API_KEY, "SCENE_LOG_LEVEL": "debug"}


def send_keys(defective: LiveService) -> None:
    """Send both keys in every part of a request, and broken HTTP."""
    client, statuses = defective.client, set()
    sent = [
        {},
        {"X-API-Key": API_KEY},
        {"X-API-Key": MISTAKEN},
        {"Authorization": f"Bearer {API_KEY}"},
        {"Authorization": f"Bearer {MISTAKEN}"},
        {"Authorization": f"Basic {MISTAKEN}"},
        {"Cookie": f"key={MISTAKEN}"},
        {"X-Request-Id": f"{MISTAKEN} {API_KEY}", "X-API-Key": API_KEY},
    ]
    for headers, key in product(sent, SECRETS):
        for method, path, body in (
            ("GET", "/health/live", None),
            ("GET", f"/{key}", None),
            ("GET", f"/models/{key}?key={key}", None),
            ("POST", f"/relations?api_key={key}", {"objects": [key], "model": key}),
            ("POST", "/relations", {"objects": ["bed"], key: key}),
            ("POST", "/relations", {"objects": [{"id": key, "label": "bed"}]}),
            ("POST", "/missing", {"objects": [{"id": key, "label": "bed"}], **ROOM}),
            ("DELETE", f"/relations?{key}", None),
        ):
            statuses.add(client.request(method, path, json=body, headers=headers).status_code)
    assert {200, 401, 404, 405, 422, 500} <= statuses

    # The server itself logs broken HTTP and clients that leave.
    broken = "GET /{key} HTTP/1.1\r\nHost x\r\nX-API-Key: {key}\r\n\r\n"
    left = (
        "POST /relations HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        "X-API-Key: {key}\r\nContent-Length: 99\r\n\r\n{key}"
    )
    for text, key in product((broken, left), SECRETS):
        with socket.create_connection(("127.0.0.1", defective.port), PATIENCE) as connection:
            connection.sendall(text.format(key=key).encode())
            connection.shutdown(socket.SHUT_WR)
            with suppress(ConnectionError):
                while connection.recv(65536):
                    pass


@pytest.mark.system
def test_keys_and_payloads_are_not_in_the_log(shared_store: Path, tmp_path: Path) -> None:
    """Of a service that logs everything, and whose question `missing` fails."""
    with launch(shared_store, tmp_path / "log", program=PROGRAM, **SETTINGS) as defective:
        send_keys(defective)
        log = defective.stop()
    # The log has the defect and the requests.
    assert "ZeroDivisionError: no class for **********" in log
    assert "GET /health/live 200" in log
    for secret in SECRETS:
        assert secret not in log
