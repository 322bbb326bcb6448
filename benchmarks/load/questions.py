"""Requests of the load test, as bytes ready to send. Each has another scene of twelve objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import httpx
import numpy as np

from benchmarks.load.connections import prepared

ROUTES = ("/missing", "/relations", "/outliers", "/rooms")
KINDS = ("12 labels", "12 poses", "20 relations")
SCENES = 64
"""Number of scenes per kind of request. It exceeds the number of connections, so that all pending
requests differ."""

_OBJECTS, _RELATIONS = 12, 20


def bodies(kind: str, labels: Sequence[str], seed: int = 0) -> list[dict[str, Any]]:
    """Return the request bodies of one kind.

    Args:
        kind: one of `KINDS`.
        labels: object labels to draw from.

    Raises:
        ValueError: `kind` is unknown.
    """
    rng = np.random.default_rng(seed)
    return [_body(kind, labels, rng) for _ in range(SCENES)]


def requests(kind: str, route: str, labels: Sequence[str]) -> list[bytes]:
    """Return the requests of one kind to a route, as bytes."""
    return [prepared(route, body) for body in bodies(kind, labels)]


def drawings(labels: Sequence[str], count: int, seed: int = 0) -> list[bytes]:
    """Return requests to /generate as bytes. Each asks for ``count`` scenes with three objects."""
    rng = np.random.default_rng(seed)
    return [
        prepared(
            "/generate",
            {
                "objects": [labels[k] for k in rng.choice(len(labels), 3, replace=False)],
                "count": count,
                "seed": number,
            },
        )
        for number in range(SCENES)
    ]


def _body(kind: str, labels: Sequence[str], rng: np.random.Generator) -> dict[str, Any]:
    chosen = [labels[k] for k in rng.choice(len(labels), _OBJECTS, replace=False)]
    if kind == "12 labels":
        return {"objects": chosen}
    if kind == "12 poses":
        positions = np.c_[rng.uniform(0, 3, (_OBJECTS, 2)), rng.uniform(0, 1, _OBJECTS)].round(3)
        size = {"x": 0.5, "y": 0.5, "z": 0.5}
        return {
            "frame_id": "base_link",
            "objects": [
                {"id": f"o{k}", "label": label, "position": dict(zip("xyz", position, strict=True)),
                 "size": size}
                for k, (label, position) in enumerate(zip(chosen, positions.tolist(), strict=True))
            ],
        }  # fmt: skip
    if kind == "20 relations":
        triples: dict[tuple[int, int, int], None] = {}
        while len(triples) < _RELATIONS:
            a, i, j = (int(x) for x in rng.integers((3, _OBJECTS, _OBJECTS)))
            if i != j and (a, j, i) not in triples:
                triples[a, i, j] = None
        return {
            "objects": chosen,
            "relations": [
                {
                    "subject": chosen[i],
                    "relation": ("left", "front", "on-top")[a],
                    "object": chosen[j],
                }
                for a, i, j in triples
            ],
        }
    raise ValueError(f"kind {kind!r} must be one of {KINDS}")


def labels_of(port: int) -> list[str]:
    """Return the labels of the default model of a service."""
    url = f"http://127.0.0.1:{port}/models/default/vocabulary"
    entries = httpx.get(url).raise_for_status().json()["objects"]
    return [entry["label"] for entry in entries if not entry["structure"]]
