"""Models: their list, changes in the store, and the health of a service with broken ones."""

import asyncio
import gc
import math
import shutil
import threading
import weakref
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from app import __version__
from app.main import create_app
from app.registry import Store
from app.scene.spatial_relations import CANONICAL, opposite
from app.settings import Settings
from tests.http.stores import PROFILES, VOCABULARY, corrupt, publish
from tests.http.test_problems import problem
from tests.questions.artifacts import places_of
from tests.services import NAMED, PATIENCE, Pause, Replace, defect, load_changes, serve


async def default(client: AsyncClient) -> str:
    response = await client.post("/relations", json={"objects": ["bed", "lamp"]})
    assert response.status_code == 200, response.text
    model = response.json()["model"]
    return f"{model['name']}@{model['version']}"


async def test_models_versions_and_aliases_are_listed(client: AsyncClient) -> None:
    listing = (await client.get("/models")).json()
    assert listing["aliases"] == {"candidate": "home@1.1.0", "default": "home@1.0.0"}
    assert listing["failures"] == []
    models = {model["name"]: model["versions"] for model in listing["models"]}
    assert set(models) == {"home", "plain", "general"}
    assert [version["version"] for version in models["home"]] == ["1.1.0", "1.0.0"]
    assert [version["aliases"] for version in models["home"]] == [["candidate"], ["default"]]
    assert {version["status"] for versions in models.values() for version in versions} == {"ready"}
    assert models["plain"][0]["variant"] == "rbm"
    for name in ("home", "default", "candidate"):
        model = (await client.get(f"/models/{name}")).json()
        assert model == {"name": "home", "versions": models["home"]}


async def test_the_vocabulary_lists_every_class(client: AsyncClient) -> None:
    words = (await client.get("/models/default/vocabulary")).json()
    assert [entry["label"] for entry in words["objects"]] == list(VOCABULARY.labels)
    for entry, known in zip(words["objects"], VOCABULARY.objects, strict=True):
        assert (entry["parent"], entry["anywhere"]) == (known.parent, known.anywhere)
        assert (entry["aliases"], entry["structure"]) == ([*known.aliases], known.structure)
        size = entry["size"]
        assert (size and tuple(size[axis] for axis in "xyz")) == known.size
    assert words["room_types"] == list(VOCABULARY.room_types)
    assert words["profiles"] == list(PROFILES)
    assert set(words["relations"]) == {*CANONICAL, *map(opposite, CANONICAL)}
    assert words["model"]["version"] == "1.0.0"
    (example,) = words["examples"]
    assert example["name"] == "A bedroom"
    assert (await client.post("/missing", json=example["scene"])).status_code == 200


async def test_the_vocabulary_names_the_classes_that_hang(own, store):
    stands = np.full((len(VOCABULARY), 3), np.float32([0.4, 0.5, 0.1]))
    stands[VOCABULARY.labels.index("lamp")] = [0.3, 0.6, 0.1]
    places = places_of(len(VOCABULARY), {(2, 2, 1): 3}, stands=stands)
    publish(store, "home", "2.0.0", alias="default", groups=[places])
    await load_changes(own)
    words = (await own.get("/models/default/vocabulary")).json()
    assert [entry["label"] for entry in words["objects"] if entry["hangs"]] == ["lamp"]
    for word, hangs in (("lamps", True), ("bed", False)):
        answer = (await own.get(f"/models/default/vocabulary/{word}")).json()
        assert answer["class"]["hangs"] is hangs


@pytest.mark.parametrize(
    ("word", "label", "rule", "certain"),
    [
        ("desk", "desk", "label", True),
        ("Bedside_Tables", "nightstand", "alias", True),
        ("pile of books", "book", "phrase", True),
        ("divan/couch", "sofa", "alternative", True),
        ("bed_2", "bed", "instance", True),
        ("keybaord", "keyboard", "spelling", False),
        ("office lamp", "lamp", "head", False),
    ],
)
async def test_a_word_becomes_a_class(client, word, label, rule, certain):
    answer = (await client.get(f"/models/default/vocabulary/{quote(word)}")).json()
    assert (answer["word"], answer["class"]["label"]) == (word, label)
    assert (answer["rule"], answer["certain"]) == (rule, certain)
    assert (answer["class"].get("parent") == "table") == (label == "desk")


@pytest.mark.parametrize(
    "path",
    [
        *("nobody", "nobody/versions/1.0.0", "home/versions/9.9.9", "home/versions/nonsense"),
        *("nobody/vocabulary", "nobody/vocabulary/bed", "home@9.9.9/vocabulary"),
    ],
)
async def test_unknown_models_are_not_found(client: AsyncClient, path: str) -> None:
    problem(await client.get(f"/models/{path}"), 404, "model-not-found")


async def test_changes_of_the_store_are_loaded(own, store, caplog):
    caplog.set_level("INFO", "app.serving")
    await load_changes(own)
    assert not caplog.messages
    before = (await own.get("/models")).json()["generation"]
    publish(store, "home", "2.0.0", seed=2, alias="default")
    shutil.rmtree(store / "general")
    assert await default(own) == "home@1.0.0"
    await load_changes(own)
    assert await default(own) == "home@2.0.0"
    problem(await own.get("/models/general"), 404, "model-not-found")
    assert caplog.messages == [
        "the service has loaded the store: 4 usable versions",
        "the alias default names home@2.0.0 now",
    ]
    after = (await own.get("/models")).json()["generation"]
    async with serve(store) as other:
        assert (await other.get("/models")).json()["generation"] == after != before


async def test_the_store_is_polled(store: Path) -> None:
    async with serve(store, store_poll=0.05) as client:
        publish(store, "home", "2.0.0", seed=2, alias="default")
        async with asyncio.timeout(60):
            while await default(client) != "home@2.0.0":  # noqa: ASYNC110 - no event tells
                await asyncio.sleep(0.05)


async def test_an_error_keeps_the_served_models(own, store, monkeypatch, caplog):
    publish(store, "home", "2.0.0", seed=2, alias="default")
    monkeypatch.setattr(Store, "names", defect)
    await load_changes(own)
    assert await default(own) == "home@1.0.0"
    assert "the service could not load the changes in the store" in caplog.text
    assert 'scene_reloads_total{outcome="failed"} 1.0' in (await own.get("/metrics")).text


@pytest.mark.parametrize("log_odds", [None, math.inf], ids=["raises", "not finite"])
async def test_a_version_without_answers_is_refused(own, store, replace, caplog, log_odds):
    served = own.app.state.runtime.models.served.values()  # type: ignore[attr-defined]

    def fails(missing: Any, model: Any, *args: Any, **parameters: Any) -> Any:
        answer = missing(model, *args, **parameters)
        if any(model is artifact.model for artifact in served):
            return answer
        if log_odds is None:
            return defect()
        return answer | {"missing": [{"log_odds": log_odds}]}

    replace("missing", fails)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    await load_changes(own)
    assert "refused the changes in the store: home@2.0.0: warm_up_failed" not in caplog.text
    assert "refused the changes in the store: default: warm_up_failed: home@2.0.0" in caplog.text
    assert ("not finite" in caplog.text) == (log_odds is not None)
    assert await default(own) == "home@1.0.0"
    counted = (await own.get("/metrics")).text
    assert 'scene_reloads_total{outcome="refused"} 1.0' in counted


async def test_requests_are_answered_during_a_load(own, store, monkeypatch):
    started, go_on, load = threading.Event(), threading.Event(), Store.load

    def slow(*args: Any) -> Any:
        started.set()
        assert go_on.wait(PATIENCE)
        return load(*args)

    monkeypatch.setattr(Store, "load", slow)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    load_all = asyncio.create_task(load_changes(own))
    assert await asyncio.to_thread(started.wait, PATIENCE)
    assert await default(own) == "home@1.0.0"
    assert (await own.get("/health/ready")).status_code == 200
    assert not load_all.done()
    go_on.set()
    await load_all
    assert await default(own) == "home@2.0.0"


async def test_a_request_keeps_its_models(own: AsyncClient, store: Path, pause: Pause) -> None:
    served = own.app.state.runtime.models.served  # type: ignore[attr-defined]
    paused = pause("missing", lambda model: model is served["home", "1.0.0"].model)
    batch = {"scenes": [{"objects": ["bed"] * 33}] * 3}  # so many are not for the event loop
    asking = asyncio.create_task(own.post("/missing/batch", json=batch))
    assert await asyncio.to_thread(paused.started.wait, PATIENCE)
    publish(store, "home", "2.0.0", seed=2, alias="default")
    await load_changes(own)
    assert await default(own) == "home@2.0.0"
    paused.release.set()
    results = (await asking).json()["results"]
    assert [entry["result"]["model"]["version"] for entry in results] == ["1.0.0"] * 3


async def test_replaced_models_are_freed(own: AsyncClient, store: Path, replace: Replace) -> None:
    weights: list[weakref.ref[Any]] = []

    def note(missing: Any, model: Any, *args: Any, **parameters: Any) -> Any:
        weights.append(weakref.ref(model.weights))
        return missing(model, *args, **parameters)

    replace("missing", note)
    for model in ("general", "home"):
        await own.post("/missing", json={"objects": ["bed"], "model": model})
    shutil.rmtree(store / "general")
    await load_changes(own)
    await own.app.state.runtime.check_store(always=True)  # type: ignore[attr-defined]
    await own.post("/missing", json={"objects": ["bed"], "model": "home"})
    replaced, kept, again = weights
    assert replaced() is None
    # An unchanged artifact is verified again and not loaded twice.
    assert again() is kept() is not None
    assert gc.get_freeze_count() > 0


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
