"""Liveness, readiness, and the answers of a service with broken models."""

import shutil
from pathlib import Path

import pytest
from httpx import ASGITransport, AsyncClient

from app import __version__
from app.main import create_app
from app.settings import Settings
from tests.http.stores import corrupt, publish
from tests.http.test_problems import problem
from tests.services import NAMED, load_changes, serve


async def test_health_of_a_ready_service(client: AsyncClient) -> None:
    answers = {"live": {"status": "live", "version": __version__}, "ready": {"status": "ready"}}
    for path, expected in answers.items():
        response = await client.get(f"/health/{path}")
        assert (response.status_code, response.json()) == (200, expected)


async def test_before_its_start_a_service_is_live_and_not_ready(shared_store: Path) -> None:
    app = create_app(Settings(store=shared_store, **NAMED))
    transport = ASGITransport(app, raise_app_exceptions=False)
    async with AsyncClient(transport=transport, base_url="http://service") as client:
        assert (await client.get("/health/live")).status_code == 200
        for path in ("/health/ready", "/models"):
            problem(await client.get(path), 503, "not-ready")
        problem(await client.post("/relations", json={"objects": ["bed"]}), 503, "not-ready")
        problem(await client.post("/missing/batch", json={"scenes": [{}]}), 503, "not-ready")


@pytest.mark.parametrize("is_removed", [False, True])
async def test_the_newest_usable_version_is_the_default(store: Path, is_removed: bool) -> None:
    publish(store, "home", "0.9.0", seed=3)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    corrupt(store, "home", "1.1.0")
    if is_removed:
        shutil.rmtree(store / "home" / "2.0.0")
    else:
        corrupt(store, "home", "2.0.0")
    async with serve(store, store_poll=0) as client:
        answer = await client.post("/relations", json={"objects": ["bed"]})
        assert answer.json()["model"]["version"] == "1.0.0"
        ready = await client.get("/health/ready")
        failures = {entry["subject"]: entry for entry in ready.json()["failures"]}
        broken = {"home@1.1.0", "default", "candidate", *(() if is_removed else ("home@2.0.0",))}
        assert (ready.status_code, set(failures)) == (200, broken)
        reason = "dangling_alias" if is_removed else "checksum_mismatch"
        assert failures["default"]["reason"] == reason
        assert failures["default"]["detail"].endswith("; home@1.0.0 answers instead")
        assert str(store) not in ready.text
        # Another alias names its own version only.
        candidate = {"objects": ["bed"], "model": "candidate"}
        problem(await client.post("/relations", json=candidate), 503, "model-unavailable")
        # A state without a default model is refused, and a repaired alias is served.
        for version in ("1.0.0", "0.9.0"):
            corrupt(store, "home", version)
        await load_changes(client)
        assert (await client.get("/health/ready")).status_code == 200
        shutil.rmtree(store / "home")
        await load_changes(client)
        assert (await client.get("/health/ready")).status_code == 200
        publish(store, "home", "3.0.0", seed=4, alias="default")
        publish(store, "home", "1.1.0", seed=4)
        await load_changes(client)
        assert (await client.get("/health/ready")).json() == {"status": "ready"}
        answer = await client.post("/relations", json={"objects": ["bed"]})
        assert answer.json()["model"]["version"] == "3.0.0"


async def test_without_a_good_version_the_service_is_not_ready(store: Path) -> None:
    for version in ("1.0.0", "1.1.0"):
        corrupt(store, "home", version)
    async with serve(store, retry_after=7) as client:
        assert (await client.get("/health/live")).status_code == 200
        response = await client.get("/health/ready")
        problem(response, 503, "not-ready")
        assert response.headers["retry-after"] == "7"
        problem(await client.post("/relations", json={"objects": ["bed"]}), 503, "not-ready")
        # Models of other names answer by their names only.
        body = {"objects": ["bed"], "model": "plain"}
        assert (await client.post("/relations", json=body)).status_code == 200
        failures = (await client.get("/models")).json()["failures"]
        named = {entry["subject"] for entry in failures}
        assert named == {"home@1.0.0", "home@1.1.0", "default", "candidate"}
        assert "instead" not in str(failures)


async def test_another_broken_version_is_listed_as_refused(store: Path) -> None:
    corrupt(store, "plain", "1.0.0")
    shutil.rmtree(store / "home" / "1.1.0")
    async with serve(store) as client:
        # An alias to a removed version is unavailable and not unknown.
        body = {"objects": ["bed"], "model": "candidate"}
        problem(await client.post("/relations", json=body), 503, "model-unavailable")
        assert (await client.get("/health/ready")).status_code == 200
        (version,) = (await client.get("/models/plain")).json()["versions"]
        details = (await client.get("/models/plain/versions/1.0.0")).json()
        assert version["status"] == details["status"] == "refused"
        assert version["reason"]
        assert version["detail"]
        assert "card" not in details
        body = {"objects": ["bed"], "model": "plain"}
        problem(await client.post("/relations", json=body), 503, "model-unavailable")
        problem(await client.get("/models/plain/vocabulary"), 503, "model-unavailable")


async def test_an_empty_store_is_not_ready(tmp_path: Path) -> None:
    async with serve(tmp_path) as client:
        problem(await client.get("/health/ready"), 503, "not-ready")
        assert (await client.get("/models")).json()["models"] == []
