"""The service as it is installed for serving: without torch, and without training."""

from __future__ import annotations

import pytest

from tests.services import LiveService

pytestmark = pytest.mark.system


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
