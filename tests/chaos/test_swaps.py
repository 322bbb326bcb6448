"""Hundreds of promotions, roll-backs and refreshes under load, some of a broken store.

Each answer names a version by its digest, and says exactly what that version says when it is asked
alone, in this process, through the questions.
"""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from app import questions
from app.registry import Artifact, Store
from app.scene import Scene, SceneObject
from benchmarks.load.connections import prepared
from tests.chaos.load import ConstantLoad
from tests.chaos.trends import trend
from tests.http.stores import corrupt, make_store, publish
from tests.services import ADMIN_KEY, LiveService, launch

SWAPS = int(os.environ.get("CHAOS_SWAPS", "500"))
VERSIONS = ("1.0.0", "1.1.0", "1.2.0")
ADMIN = {"X-Admin-Key": ADMIN_KEY}
SCENES: list[dict[str, Any]] = [
    {"objects": ["bed", "lamp"], "top_k": 4},
    {"objects": ["desk", "chair", "keyboard"], "top_k": 4},
    {"objects": ["sink", {"label": "toilet", "confidence": 0.5}], "top_k": 4},
    {"objects": ["sofa", "television"], "room_type": "office", "top_k": 4},
]
REQUESTS = [prepared("/missing", body) for body in SCENES]
Answers = list[list[tuple[str, float, float]]]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    store = make_store(tmp_path / "store")
    publish(store, "home", "1.2.0", seed=2)
    return store


def offline(artifact: Artifact) -> Answers:
    """The answers of this version to each scene."""
    answers = []
    for body in SCENES:
        answer = questions.missing(artifact, scene_of(artifact, body), top_k=body["top_k"])
        answers.append(scores(answer["missing"]))
    return answers


def scores(entries: list[dict[str, Any]]) -> list[tuple[str, float, float]]:
    return [(entry["label"], entry["probability"], entry["log_odds"]) for entry in entries]


class Judge:
    """Compares each answer with that of the version that it names, asked in this process.

    Attributes:
        expected: the answers by the digest of their version.
        seen: digests of the versions that answered.
    """

    def __init__(self, store: Store, versions: Iterable[str]) -> None:
        artifacts = [store.load("home", version) for version in versions]
        self.expected = {artifact.digest: offline(artifact) for artifact in artifacts}
        self.seen: set[str] = set()

    def __call__(self, number: int, status: int, answer: Any) -> str | None:
        if status != 200:
            return f"status {status}: {answer}"
        digest = answer["model"]["digest"]
        self.seen.add(digest)
        missing, expected = scores(answer["missing"]), self.expected[digest][number]
        return None if missing == expected else f"{answer['model']}: {missing}, not {expected}"


def scene_of(artifact: Artifact, body: dict[str, Any]) -> Scene:
    """The scene of a request, in the classes of a model."""
    words = artifact.vocabulary
    objects = []
    for entry in body["objects"]:
        label, confidence = entry, 1.0
        if isinstance(entry, dict):
            label, confidence = entry["label"], entry["confidence"]
        objects.append(SceneObject(label, label, words.index(label), confidence=confidence))
    room = body.get("room_type")
    return Scene(tuple(objects), room_type=None if room is None else words.room_types.index(room))


def put_broken(store: Path, number: int) -> Path:
    """A version that must be refused, made beside the store and moved in at once."""
    beside = store.parent / "beside"
    shutil.copytree(store / "home" / "1.2.0", beside / "home" / "1.2.0")
    corrupt(beside, "home", "1.2.0")
    return (beside / "home" / "1.2.0").rename(store / "home" / f"9.{number}.0")


# -------------------------------------------------------------------------------------- tests


def swap(service: LiveService, store: Path, number: int) -> list[str]:
    """One change of what is served: what went wrong with it, if anything."""
    client = service.client
    version = VERSIONS[number % len(VERSIONS)]
    if number % 5 == 3:
        broken = put_broken(store, number)
        response = client.post("/models/refresh", headers=ADMIN)
        shutil.rmtree(broken)
        good = response.status_code == 409 and response.json()["failures"]
        return [] if good else [f"{number}: a broken version: {response.text}"]
    if number % 5 == 4:
        response = client.post("/models/refresh", headers=ADMIN)
        return [] if response.status_code == 200 else [f"{number}: refresh: {response.text}"]
    if number % 5 == 2:
        # A version that comes and goes: loaded anew each time, and let go.
        place = store / "home" / "0.9.0"
        if place.exists():
            shutil.rmtree(place)
        else:
            publish(store, "home", "0.9.0", seed=9)
        response = client.post("/models/refresh", headers=ADMIN)
        return [] if response.status_code == 200 else [f"{number}: comes and goes: {response.text}"]
    alias = {"model": f"home@{version}"}
    response = client.put("/models/aliases/default", json=alias, headers=ADMIN)
    served = client.post("/missing", json={"objects": ["bed"]}).json()["model"]["version"]
    good = response.status_code == 200 and served == version
    return [] if good else [f"{number}: alias: {response.text}, then {served}"]


@pytest.fixture
def service(store: Path, tmp_path: Path) -> Iterator[LiveService]:
    # Without polls: after a poll, a refresh accepts the broken version as a known failure.
    variables = {"SCENE_ACCESS_LOG": "false", "SCENE_STORE_POLL": "0"}
    with launch(store, tmp_path / "log", **variables) as service:
        yield service


def test_no_answer_is_lost_or_mixed_and_no_memory_kept(service: LiveService, store: Path) -> None:
    judge = Judge(Store(store), VERSIONS)
    before = service.control()
    faults: list[str] = []
    readings: list[int] = []
    with ConstantLoad(service.port, REQUESTS, judge, connections=4) as load:
        for number in range(SWAPS):
            faults += swap(service, store, number)
            if number >= SWAPS // 5:
                readings.append(service.memory)
    assert faults == []
    assert load.tally.faults == []
    assert sum(load.tally.statuses.values()) == load.tally.sent
    assert judge.seen == set(judge.expected)
    alias = {"model": "home@1.0.0"}
    assert service.client.put("/models/aliases/default", json=alias, headers=ADMIN).is_success
    assert service.control() == before
    grown = trend(readings)
    # A model of this store has 10 kB of weights; a version that is never let go would show as the
    # hundred kB that its artifact, its compiled views and its card take together, each time.
    assert grown.growth < max(4 * 2**20, grown.noise), grown
    log = service.log.read_text()
    assert "Traceback" not in log
    gc.collect()
