"""Deadlines, queues, and the requests in progress at the end of the service."""

import asyncio
import math
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from httpx import Client, ConnectError, Response

from tests.http.test_documentation import inlined
from tests.http.test_problems import problem
from tests.services import Pause, launch, serve, wait_until

SCENE = {"objects": ["bed", "chair", "lamp"]}
LONG = {"X-Request-Timeout-Ms": "60000"}


async def test_a_deadline_is_a_whole_number_within_the_limit(shared_store: Path) -> None:
    async with serve(shared_store, max_request_timeout_ms=600_000) as client:
        for value in ("0", "-1", "1.5", "", "soon", "NaN", b"\xff", "9" * 400, "600001", "600000"):
            headers: Any = {"X-Request-Timeout-Ms": value}
            for path, body in (("/relations", SCENE), ("/missing/batch", {"scenes": [SCENE]})):
                response = await client.post(path, json=body, headers=headers)
                if value == "600000":
                    assert response.status_code == 200
                else:
                    document = problem(response, 400, "bad-request")
                    assert "from 1 to 600000" in document["detail"]
            # Health checks ignore the header.
            assert (await client.get("/health/ready", headers=headers)).is_success
        document = (await client.get("/openapi.json", headers=headers)).json()
    parameters = inlined(document["paths"]["/missing"]["post"]["parameters"], document)
    assert [p["schema"]["maximum"] for p in parameters if "Timeout" in p["name"]] == [600_000]


async def test_generate_past_its_deadline_gets_504(shared_store: Path, pause: Pause) -> None:
    async with serve(shared_store) as client:
        paused = pause("generate")
        drawing = asyncio.ensure_future(
            client.post("/generate", json=SCENE, headers={"X-Request-Timeout-Ms": "1000"})
        )
        for question in ("relations", "missing", "outliers"):
            assert (await client.post(f"/{question}", json=SCENE, headers=LONG)).is_success
        problem(await drawing, 504, "deadline-passed")
        paused.release.set()
        assert (await client.post("/generate", json=SCENE, headers=LONG)).is_success
        assert 'scene_pending{lane="draws"} 0.0' in (await client.get("/metrics")).text


async def test_a_client_above_its_share_gets_429(shared_store: Path, pause: Pause) -> None:
    async with serve(shared_store) as client:
        client.headers.update(LONG)
        paused = pause("generate")
        largest = {**SCENE, "count": 64, "steps": 500}
        drawing = asyncio.ensure_future(client.post("/generate", json=largest))
        assert await asyncio.to_thread(paused.started.wait, 60)
        response = await client.post("/generate", json=SCENE)
        problem(response, 429, "queue-full")
        assert int(response.headers["retry-after"]) >= 1
        # Other questions have queues of their own.
        assert (await client.post("/missing", json=SCENE)).is_success
        assert (await client.post("/missing/batch", json={"scenes": [SCENE] * 256})).is_success
        assert (await client.get("/health/ready")).is_success
        paused.release.set()
        assert (await drawing).is_success
        assert (await client.post("/generate", json=SCENE)).is_success
        too_much = await client.post("/generate", json={**largest, "steps": 501})
        document = problem(too_much, 422, "invalid-request")
        assert "`steps` must be at most 32000" in document["errors"][0]["message"]


async def test_a_batch_stops_at_its_deadline(shared_store, replace, monkeypatch):
    """Each entry that was not begun says so itself. The deadline passes during the third entry."""
    begun = 0

    def slow(missing: Any, *args: Any, **parameters: Any) -> Any:
        nonlocal begun
        begun += 1
        if begun == 3:
            monkeypatch.setattr("app.serving.admission.monotonic", lambda: math.inf)
        return missing(*args, **parameters)

    async with serve(shared_store) as client:
        replace("missing", slow)
        answer = await client.post("/missing/batch", json={"scenes": [SCENE] * 20}, headers=LONG)
    assert begun == 3
    assert [entry["status"] for entry in answer.json()["results"]] == [200] * 2 + [504] * 18


WAITING = """
import sys, time
from pathlib import Path
from app.__main__ import main
from app.questions.generate import GENERATE

generate, begun, release = GENERATE.answer, Path({begun!r}), Path({release!r})

def waiting(*args, **parameters):
    if parameters["count"] == 3:
        begun.touch()
        while not release.exists():
            time.sleep(0.01)
    return generate(*args, **parameters)

GENERATE.answer = waiting
sys.exit(main())
"""
"""A program for `launch`: drawing three scenes takes until the file `release` exists."""


@pytest.mark.slow
@pytest.mark.system
def test_a_stopping_service_drains(shared_store: Path, tmp_path: Path) -> None:
    begun, release = tmp_path / "begun", tmp_path / "release"
    program = WAITING.format(begun=str(begun), release=str(release))
    log = tmp_path / "log"
    with launch(shared_store, log, program=("-c", program), SCENE_DRAIN_SECONDS="3") as service:
        answers: list[Response] = []

        def draw() -> None:
            with Client(base_url=service.client.base_url, timeout=60) as client:
                answers.append(client.post("/generate", json={**SCENE, "count": 3}, headers=LONG))

        def is_draining() -> bool:
            return service.client.get("/health/ready").status_code == 503

        drawing = threading.Thread(target=draw)
        drawing.start()
        wait_until(begun.exists)
        service.process.send_signal(signal.SIGTERM)
        wait_until(is_draining)
        late = service.client.post("/relations", json=SCENE)
        assert late.status_code == 200
        assert late.headers["connection"] == "close"
        refused = service.client.get("/health/ready")
        problem(refused, 503, "draining")
        assert "retry-after" in refused.headers
        assert service.client.get("/health/live").is_success
        assert not answers
        release.touch()
        drawing.join(timeout=60)
        assert answers[0].status_code == 200
        service.process.wait(timeout=30)
        assert service.process.returncode == -signal.SIGTERM
        with pytest.raises(ConnectError):
            service.client.get("/health/live")
