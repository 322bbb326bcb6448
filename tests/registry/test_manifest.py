"""The manifest: it is read as it was written, and invalid fields are errors."""

import json
import math
from functools import reduce
from operator import getitem
from typing import Any

import pytest
from pydantic import ValidationError

from app.registry import ArtifactError, Manifest
from app.registry.manifest import FORMAT
from tests.registry.small_artifacts import description, refused, resign

DIGEST = "ab" * 32
FILES = {name: {"sha256": DIGEST, "bytes": 2} for name in ("model.safetensors", "card.md")}


def manifest(**changes: Any) -> Manifest:
    tensors = {"b": {"dtype": "float32", "shape": [3]}}
    fields = {**dict(description()), "tensors": tensors, "files": FILES, **changes}
    return Manifest.model_validate(fields)


def stored() -> dict[str, Any]:
    members: dict[str, Any] = json.loads(manifest().to_bytes())
    del members["checksum"]
    return members


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (FORMAT - 1, r"outdated_format.*train the model again"),
        *(
            (value, r"unknown_format.*publish the model again")
            for value in (FORMAT + 1, float(FORMAT), str(FORMAT), None, True, 0, -1)
        ),
    ],
)
def test_refuses_another_format(value: object, expected: str) -> None:
    body = json.dumps(stored() | {"format": value}).encode()
    # Another format may end in another way, so the format is read before the checksum.
    for data in (resign(body), body):
        with pytest.raises(ArtifactError, match=expected):
            Manifest.from_bytes(data)


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", "truncated"),
        (b"[]", "invalid_manifest"),
        (b"null\n", "invalid_manifest"),
        (b"\xff\xfe", "truncated"),
        (b"[" * 200_000, "truncated"),
        (resign(b"{" + b'"a":[' * 100_000 + b"]" * 100_000 + b"}"), "invalid_manifest"),
        (resign(b'{"format": %d, nonsense}' % FORMAT), "invalid_manifest"),
        (b'{"format": %d}' % FORMAT, "invalid_manifest"),
        (resign(b'{"format": %d}' % FORMAT), "invalid_manifest"),
    ],
)
def test_refuses_malformed_manifests(data: bytes, code: str) -> None:
    with refused(code):
        Manifest.from_bytes(data)


INVALID: dict[str, list[Any]] = {
    **{key: [1] for key in ("surplus", "calibration.outlier.surplus", "spec.profiles")},
    "name": ["../up", "Upper", "a\n"],
    "version": ["1.0", "01.0.0", "1.0.0\n"],
    "created": ["2020-02-02T20:20:20", "yesterday"],  # no time zone
    "spec.V": [4],
    "spec.A": [2],
    "spec.C": [5],
    "vocabulary.profiles": [["homes"]],
    "vocabulary.relations": [["left", "front", "above", "on-top"]],
    "vocabulary.objects.1.label": ["beds"],  # the plural of another one
    "vocabulary.objects.0.size": [[1.0, 2.0], [1.0, 2.0, -3.0]],
    **{key: [[]] for key in ("calibration.relation", "calibration.at")},
    "calibration.at.0.slope": [0],
    "calibration.misplaced.under.lines": [None],
    "calibration.outlier_lines": [None],  # the fit needs its lines
    "calibration.outlier": [None],  # without a fit, there are no lines
    "training.rate": [math.nan],
    "examples": [
        [{"name": "a", "scene": {"objects": ["bed"], "model": "other"}}],
        [{"name": "a", "scene": {"objects": ["bed"]}}] * 9,
    ],
    "files": [{}, *({**FILES, name: FILES["card.md"]} for name in ("model.pkl", "../card.md"))],
}


@pytest.mark.parametrize(
    ("path", "value"), [(path, value) for path, values in INVALID.items() for value in values]
)
def test_refuses_a_field_that_does_not_fit(path: str, value: object) -> None:
    members = stored()
    *outer, last = (int(step) if step.isdigit() else step for step in path.split("."))
    reduce(getitem, outer, members)[last] = value
    with refused("invalid_manifest"):
        Manifest.from_bytes(resign(json.dumps(members).encode()))


def test_refuses_a_missing_field() -> None:
    for missing in {*Manifest.model_fields} - {"examples", "format"}:
        members = stored()
        del members[missing]
        with pytest.raises(ArtifactError, match=f"invalid_manifest.*{missing}"):
            Manifest.from_bytes(resign(json.dumps(members).encode()))


@pytest.mark.parametrize(
    "change",
    [
        {"training": {"rate": math.inf}},
        {"training": {"\ud800": 1}},
        {"training": {"note": "\ud800"}},
        {"terms": "\ud800"},
        {"libraries": {"torch": "\ud800"}},
    ],
)
def test_a_description_can_always_be_written(change: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        description(**change)
