"""Host names that the service accepts, and whether it is open to other machines."""

import re
from pathlib import Path
from socket import gethostname

import pytest
from httpx import AsyncClient, Response

from app.api.gateway import HEALTH
from app.settings import Settings
from tests.http.test_problems import problem
from tests.services import Replace, client_of_service, defect, serve

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
API_KEY = "incorrect-zebra-capacitor-nail"

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
