"""Host names that the service accepts, and whether it is open to other machines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from app.settings import Settings
from tests.http.test_problems import problem
from tests.services import serve

SCENE = {"objects": ["bed"]}
LOCAL = {"127.0.0.1", "localhost", "[::1]"}


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SCENE_HOST", "SCENE_ALLOWED_HOSTS", "SCENE_API_KEY"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, LOCAL),
        ({"host": "0.0.0.0"}, LOCAL),
        ({"host": "::"}, LOCAL),
        ({"host": "10.0.0.7"}, {*LOCAL, "10.0.0.7"}),
        ({"host": "fd00::7"}, {*LOCAL, "[fd00::7]"}),
        ({"host": "Robot.local"}, {*LOCAL, "robot.local"}),
        ({"allowed_hosts": "scene, Robot.local [fd00::7]"}, {"scene", "robot.local", "[fd00::7]"}),
        ({"allowed_hosts": "::1"}, {"[::1]"}),
        ({"allowed_hosts": "scene,*"}, None),
    ],
)
def test_names_are_those_of_this_machine_or_listed(
    tmp_path: Path, settings: dict[str, Any], expected: set[str] | None
) -> None:
    assert Settings(store=tmp_path, **settings).accepted_hosts == expected


async def test_requests_for_another_host_are_refused(shared_store: Path) -> None:
    accepted = ("127.0.0.1", "127.0.0.1:8000", "LOCALHOST:1", "[::1]:8000")
    others = ("evil.example", "127.0.0.1.evil.example", "localhost@evil.example")
    malformed = ("localhost:80:80", "localhost:port", "::1", "")
    async with serve(shared_store, allowed_hosts=()) as client:
        for host in (*accepted, *others, *malformed):
            headers = {"Host": host}
            response = await client.post("/relations", json=SCENE, headers=headers)
            if host in accepted:
                assert response.status_code == 200, host
            else:
                problem(response, 421, "host-refused")
            # Orchestrators ask by the address of a replica.
            for path in ("/health/live", "/health/ready", "/v2/health/ready"):
                assert (await client.get(path, headers=headers)).status_code == 200
        twice = [("Host", "localhost"), ("Host", "localhost")]
        problem(await client.get("/models", headers=twice), 421, "host-refused")
