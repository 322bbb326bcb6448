"""Liveness, readiness, and the answers of a service with broken models."""

from __future__ import annotations

import shutil
from pathlib import Path

import httpx
import pytest

from app import __version__
from app.main import create_app
from app.settings import Settings
from tests.http.stores import corrupt
from tests.http.test_problems import problem
from tests.services import NAMED, LiveService, serve

READY = ["/health/ready", "/v2/health/ready", "/v2/models/default/ready"]


async def test_health_of_a_ready_service(client: httpx.AsyncClient) -> None:
    answers = {
        "/health/live": {"status": "live"},
        "/health/ready": {"status": "ready"},
        "/v2/health/live": {"live": True},
        "/v2/health/ready": {"ready": True},
        "/v2/models/candidate/ready": {"name": "home", "ready": True},
    }
    for path, expected in answers.items():
        response = await client.get(path)
        assert (response.status_code, response.json()) == (200, expected)


async def test_protocol_metadata(client: httpx.AsyncClient) -> None:
    server = (await client.get("/v2")).json()
    assert server == {"name": "scene-boltzmann", "version": __version__, "extensions": []}
    model = (await client.get("/v2/models/default")).json()
    described = {"name": "home", "versions": ["1.0.0", "1.1.0"], "platform": "numpy_triway"}
    assert model == described | {"inputs": [], "outputs": []}


async def test_before_its_start_a_service_is_live_and_not_ready(shared_store: Path) -> None:
    app = create_app(Settings(store=shared_store, **NAMED))
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
        assert (await client.get("/health/live")).status_code == 200
        for path in (*READY, "/models"):
            problem(await client.get(path), 503, "not-ready")
        problem(await client.post("/relations", json={"objects": ["bed"]}), 503, "not-ready")
        problem(await client.post("/missing/batch", json={"scenes": [{}]}), 503, "not-ready")


async def test_a_broken_default_keeps_the_service_not_ready(store: Path) -> None:
    corrupt(store, "home", "1.0.0")
    async with serve(store, retry_after=7) as client:
        assert (await client.get("/health/live")).status_code == 200
        for path in READY:
            response = await client.get(path)
            problem(response, 503, "not-ready")
            assert response.headers["retry-after"] == "7"
        problem(await client.post("/relations", json={"objects": ["bed"]}), 503, "not-ready")
        # Another version does not replace it, and answers by its own name.
        body = {"objects": ["bed"], "model": "home@1.1.0"}
        assert (await client.post("/relations", json=body)).status_code == 200
        failures = {
            entry["subject"]: entry for entry in (await client.get("/models")).json()["failures"]
        }
        assert set(failures) == {"home@1.0.0", "default"}
        assert failures["home@1.0.0"]["reason"] == "checksum_mismatch"
        assert str(store) not in str(failures)


async def test_another_broken_version_is_listed_as_refused(store: Path) -> None:
    corrupt(store, "plain", "1.0.0")
    shutil.rmtree(store / "home" / "1.1.0")
    async with serve(store) as client:
        # An alias to a removed version is unavailable and not unknown.
        body = {"objects": ["bed"], "model": "candidate"}
        problem(await client.post("/relations", json=body), 503, "model-unavailable")
        for path in READY:
            assert (await client.get(path)).status_code == 200
        (version,) = (await client.get("/models/plain")).json()["versions"]
        details = (await client.get("/models/plain/versions/1.0.0")).json()
        assert version["status"] == details["status"] == "refused"
        assert version["reason"]
        assert version["detail"]
        assert "card" not in details
        body = {"objects": ["bed"], "model": "plain"}
        problem(await client.post("/relations", json=body), 503, "model-unavailable")
        for path in ("models/plain/vocabulary", "models/plain/contexts", "v2/models/plain/ready"):
            problem(await client.get(f"/{path}"), 503, "model-unavailable")


async def test_an_empty_store_is_not_ready(tmp_path: Path, admin: dict[str, str]) -> None:
    async with serve(tmp_path) as client:
        problem(await client.get("/health/ready"), 503, "not-ready")
        assert (await client.get("/models")).json()["models"] == []
        problem(await client.post("/models/refresh", headers=admin), 409, "refresh-refused")


@pytest.mark.system
def test_every_variant_answers_without_torch(live: LiveService) -> None:
    """In the process of `live`, the import of torch, training and OpenTelemetry fails."""
    client = live.client
    listed = client.get("/models").json()
    assert not listed["failures"]
    variants = {entry["versions"][0]["variant"] for entry in listed["models"]}
    assert variants == {"triway", "gbm", "rbm"}
    for entry in listed["models"]:
        body = {
            "objects": ["bed", "lamp", "desk"],
            "relations": [{"subject": "lamp", "relation": "on-top", "object": "desk"}],
            "model": entry["name"],
        }
        for question in ("relations", "missing", "outliers", "rooms", "generate"):
            answer = client.post(f"/{question}", json=body)
            assert answer.status_code == 200, answer.text
        assert client.get(f"/models/{entry['name']}/contexts").status_code == 200
