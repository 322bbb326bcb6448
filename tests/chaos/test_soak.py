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
from tests.chaos.load import ConstantLoad
from tests.chaos.trends import trend
from tests.services import ADMIN_KEY, LiveService, live_service

MINUTES = float(os.environ.get("CHAOS_SOAK_MINUTES", "0"))
CYCLE = 5.0

pytestmark = pytest.mark.skipif(MINUTES <= 0, reason="CHAOS_SOAK_MINUTES says how long")


service = live_service(SCENE_ACCESS_LOG="false")


def cycle(service: LiveService, hostile: list[corpus.Hostile]) -> list[str]:
    """Some seconds of use: hostile requests, promotions, refreshes."""
    report = attack(service.port, hostile)
    faults = report.faults
    admin = {"X-Admin-Key": ADMIN_KEY}
    for version in ("1.1.0", "1.0.0"):
        alias = {"model": f"home@{version}"}
        response = service.client.put("/models/aliases/default", json=alias, headers=admin)
        if not response.is_success:
            faults.append(response.text)
    response = service.client.post("/models/refresh", headers=admin)
    if not response.is_success:
        faults.append(response.text)
    return faults


def test_nothing_grows(service: LiveService) -> None:
    before = service.control()
    requests = [
        prepared(route, {"objects": ["bed", "lamp", "desk", "chair"], "seed": 1} | extra)
        for route, extra in {
            "/relations": {},
            "/missing": {},
            "/outliers": {},
            "/rooms": {},
            "/generate": {"steps": 8},
        }.items()
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
    assert faults + load.tally.faults == []
    assert sum(load.tally.statuses.values()) == load.tally.sent
    assert service.control() == before
    assert service.descriptors <= files + 8
    settled = readings[len(readings) // 4 :]
    grown = trend(settled)
    print("resident, MiB:", *(reading >> 20 for reading in readings))  # all of it, where it fails
    assert grown.growth < max(4 * 2**20, grown.noise), grown
