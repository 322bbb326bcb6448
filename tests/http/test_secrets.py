"""The log has no keys and no payloads, at any level and for any error."""

import socket
from collections.abc import Iterator
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest

from tests.services import DEFECTIVE, PATIENCE, LiveService, launch

pytestmark = pytest.mark.system

API_KEY = "incorrect-zebra-capacitor-nail"
# What a client sends by mistake is a secret too, if perhaps of another service.
MISTAKEN = "mistaken-walrus-umbrella-fork"
SECRETS = (API_KEY, MISTAKEN)
ROOM = {"room_type": "bedroom"}

# The message of the error quotes a key.
PROGRAM = ("-c", DEFECTIVE.format(message=f"no class for {API_KEY}"))
SETTINGS = {"SCENE_API_KEY": API_KEY, "SCENE_LOG_LEVEL": "debug"}


@pytest.fixture
def defective(shared_store: Path, tmp_path: Path) -> Iterator[LiveService]:
    """A service that logs everything, and whose question `missing` fails."""
    with launch(shared_store, tmp_path / "log", program=PROGRAM, **SETTINGS) as service:
        yield service


def test_keys_and_payloads_are_not_in_the_log(defective: LiveService) -> None:
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

    log = defective.stop()
    # The log has the defect and the requests.
    assert "ZeroDivisionError: no class for **********" in log
    assert "GET /health/live 200" in log
    for secret in SECRETS:
        assert secret not in log
