"""The service as it is installed for serving: without torch, and without training."""

from __future__ import annotations

from pathlib import Path

from tests.http.stores import make_store
from tests.services import launch

_WITHOUT = """
import runpy, sys
for name in ("torch", "training", "opentelemetry.sdk"):
    sys.modules[name] = None  # importing them fails
runpy.run_module("app", run_name="__main__")
"""


def test_every_question_is_answered(tmp_path: Path) -> None:
    """By models of every variant."""
    with launch(
        make_store(tmp_path / "store"), tmp_path / "log", program=("-c", _WITHOUT)
    ) as service:
        client = service.client
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
