"""Equal requests have equal answers, alone and under load."""

import pytest

from benchmarks.load.connections import prepared
from tests.chaos.load import ConstantLoad
from tests.services import LiveService

pytestmark = pytest.mark.system

BATCHES = [f"/{question}/batch" for question in ("relations", "missing", "outliers", "rooms")]
SINGLE = ["/relations", "/missing", "/outliers", "/rooms", "/generate"]
LABELS = ("bed", "lamp", "desk", "chair", "sofa", "sink", "book", "pillow", "table")


def others() -> list[bytes]:
    """Requests of each kind that differ from each other."""
    made = []
    for path in (*SINGLE, *BATCHES):
        for k in range(8):
            scene = {"objects": [LABELS[(k + j) % 9] for j in range(1 + k)], "seed": k}
            if path == "/generate":
                scene |= {"count": 1 + k % 3, "steps": 5 + k}
            made.append(prepared(path, {"scenes": [scene]} if path in BATCHES else scene))
    return made


def test_answers_under_load_are_the_same(live: LiveService) -> None:
    def judge(_: int, status: int, __: object) -> str | None:
        return None if status == 200 else f"status {status}"

    alone = live.control()
    with ConstantLoad(live.port, others(), judge, connections=24):
        for _ in range(3):
            assert live.control() == alone
