"""Hundreds of promotions, roll-backs and refreshes under load, some of a broken store.

Each answer names a version by its digest, and says exactly what this version says without load.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import httpx

from benchmarks.load.connections import prepared
from tests.chaos.load import ConstantLoad, check_growth
from tests.http.stores import corrupt, publish
from tests.services import ADMIN_KEY, launch

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


class Judge:
    """Compares each answer with that of the version that it names, asked before the load.

    Attributes:
        expected: the answers of each version by its digest.
        seen: digests of the versions that answered.
    """

    def __init__(self, client: httpx.Client, versions: Iterable[str]) -> None:
        self.expected: dict[str, list[Any]] = {}
        self.seen: set[str] = set()
        for version in versions:
            for scene in SCENES:
                body = scene | {"model": f"home@{version}"}
                answer = client.post("/missing", json=body).json()
                assert answer["model"]["version"] == version
                self.expected.setdefault(answer["model"]["digest"], []).append(answer["missing"])

    def __call__(self, number: int, status: int, answer: Any) -> str | None:
        if status != 200:
            return f"status {status}: {answer}"
        digest = answer["model"]["digest"]
        self.seen.add(digest)
        missing, expected = answer["missing"], self.expected[digest][number]
        return None if missing == expected else f"{answer['model']}: {missing}, not {expected}"


def swap(client: httpx.Client, store: Path, number: int) -> None:
    """Change what is served, and check the result."""
    kind = number % 5
    if kind < 2:
        version = VERSIONS[number % len(VERSIONS)]
        alias = {"model": f"home@{version}"}
        response = client.put("/models/aliases/default", json=alias, headers=ADMIN)
        assert response.status_code == 200, response.text
        served = client.post("/missing", json={"objects": ["bed"]}).json()["model"]["version"]
        assert served == version, number
        return
    broken, place = store / "home" / f"9.{number}.0", store / "home" / "0.9.0"
    if kind == 3:  # a broken version, made beside the store and moved in at once
        beside = store.parent / "beside"
        shutil.copytree(store / "home" / "1.2.0", beside / "home" / "1.2.0")
        corrupt(beside, "home", "1.2.0")
        (beside / "home" / "1.2.0").rename(broken)
    elif kind == 2 and place.exists():  # a version that comes and goes is loaded anew each time
        shutil.rmtree(place)
    elif kind == 2:
        publish(store, "home", "0.9.0", seed=9)
    response = client.post("/models/refresh", headers=ADMIN)
    assert response.status_code == (409 if kind == 3 else 200), (number, response.text)
    if kind == 3:
        assert response.json()["failures"]
        shutil.rmtree(broken)


def test_no_answer_is_lost_or_mixed_and_no_memory_kept(store: Path, tmp_path: Path) -> None:
    publish(store, "home", "1.2.0", seed=2)
    # Without polls: after a poll, a refresh accepts the broken version as a known failure.
    variables = {"SCENE_ACCESS_LOG": "false", "SCENE_STORE_POLL": "0"}
    with launch(store, tmp_path / "log", **variables) as service:
        judge, before, readings = Judge(service.client, VERSIONS), service.control(), []
        with ConstantLoad(service.port, REQUESTS, judge, connections=4) as load:
            for number in range(SWAPS):
                swap(service.client, store, number)
                if number >= SWAPS // 5:
                    readings.append(service.memory)
        load.tally.check()
        assert judge.seen == set(judge.expected)
        alias = {"model": "home@1.0.0"}
        assert service.client.put("/models/aliases/default", json=alias, headers=ADMIN).is_success
        assert service.control() == before
        # A model of this store has 10 kB of weights. A version that is never freed would show as
        # the hundred kB of its artifact, its compiled views and its card, each time.
        check_growth(readings)
        assert "Traceback" not in service.log.read_text()
