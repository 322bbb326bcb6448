"""A live service with settings of one's own, and what it takes of the machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.http.conftest import LiveService, launch

CONTROL = {"objects": ["bed", "lamp", {"id": "desk_1", "label": "desk"}], "seed": 11}


@contextmanager
def running(store: Path, log: Path, **settings: str) -> Iterator[LiveService]:
    """``python -m app`` over a store; settings by name, as SCENE_*."""
    variables = {f"SCENE_{name.upper()}": value for name, value in settings.items()}
    service = launch(store, log, **variables)
    try:
        yield service
    finally:
        service.client.close()
        service.process.terminate()
        service.process.wait(timeout=30)


def memory(service: LiveService) -> int:
    """Resident bytes."""
    for line in Path(f"/proc/{service.process.pid}/status").read_text("ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise ProcessLookupError(service.process.pid)


def descriptors(service: LiveService) -> int:
    """Open files and sockets."""
    return len(list(Path(f"/proc/{service.process.pid}/fd").iterdir()))


def control(service: LiveService) -> dict[str, bytes]:
    """The answers to one question of each kind, which never change."""
    answers = {}
    for question in ("relations", "missing", "outliers", "generate"):
        body = CONTROL | ({"steps": 8} if question == "generate" else {})
        headers = {"X-Request-Id": "control"}
        response = service.client.post(f"/{question}", json=body, headers=headers)
        assert response.status_code == 200, response.text
        answers[question] = response.content
    assert service.client.get("/health/ready").status_code == 200
    return answers
