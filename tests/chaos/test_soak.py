"""Minutes of ordinary use with everything in it: memory, files and answers stay as they are.

Longer than the other attacks together, so it runs only where it is asked for: `make soak`.
"""

from __future__ import annotations

import os
import time
from itertools import count
from typing import Any

import pytest

from benchmarks.load.connections import prepared
from tests.chaos import corpus
from tests.chaos.attack import attack
from tests.chaos.load import ConstantLoad, check_growth
from tests.services import ADMIN_KEY, LiveService, live_service

MINUTES = float(os.environ.get("CHAOS_SOAK_MINUTES", "0"))
CYCLE = 5.0

pytestmark = pytest.mark.skipif(MINUTES <= 0, reason="CHAOS_SOAK_MINUTES says how long")


service = live_service(SCENE_ACCESS_LOG="false")


def cycle(service: LiveService, hostile: list[corpus.Hostile]) -> list[str]:
    """Send hostile requests, promotions and a refresh, and return what went wrong."""
    faults, admin = attack(service.port, hostile).faults, {"X-Admin-Key": ADMIN_KEY}
    moves = [("PUT", "/models/aliases/default", {"model": f"home@1.{k}.0"}) for k in (1, 0)]
    for method, path, body in (*moves, ("POST", "/models/refresh", None)):
        response = service.client.request(method, path, json=body, headers=admin)
        faults += [] if response.is_success else [response.text]
    return faults


def test_nothing_grows(service: LiveService) -> None:
    before = service.control()
    scene = {"objects": ["bed", "lamp", "desk", "chair"], "seed": 1}
    requests = [prepared("/generate", scene | {"steps": 8})]
    requests += [
        prepared(f"/{name}", scene) for name in ("relations", "missing", "outliers", "rooms")
    ]
    every = list(corpus.requests())
    readings: list[int] = []
    faults: list[str] = []

    def judge(_: int, status: int, answer: Any) -> str | None:
        return None if status == 200 else f"status {status}: {answer}"

    # What the allocator keeps for the largest bodies is kept once, and is no growth. All of them:
    # a cycle sends a hundredth, so that new ones would come for eight minutes.
    for _ in range(2):
        attack(service.port, every)
    files = service.descriptors
    end = time.monotonic() + 60 * MINUTES
    with ConstantLoad(service.port, requests, judge, connections=2) as load:
        for number in count():
            if time.monotonic() >= end:
                break
            began = time.monotonic()
            faults += cycle(service, every[number % 97 :: 97])
            readings.append(service.memory)
            time.sleep(max(0.0, CYCLE - (time.monotonic() - began)))
    assert faults == []
    load.tally.check()
    assert service.control() == before
    assert service.descriptors <= files + 8
    print("resident, MiB:", *(reading >> 20 for reading in readings))
    check_growth(readings[len(readings) // 4 :])
