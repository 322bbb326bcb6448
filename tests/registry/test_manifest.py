"""The manifest: it is read as it was written, and invalid fields are errors."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from app.registry import (
    AlarmLine,
    AlarmLines,
    ArtifactError,
    Calibration,
    CountSlope,
    Judgement,
    Manifest,
    Misplaced,
    PlaceFit,
)
from app.registry.description import KINDS, PAIR_CALIBRATIONS, VocabularyEntry
from app.registry.manifest import TensorEntry
from app.scene.relations import CANONICAL
from tests.registry.small_artifacts import VOCABULARY, description, refused, resign

DIGEST = "ab" * 32
FILES = {
    "model.safetensors": {"sha256": DIGEST, "bytes": 1},
    "card.md": {"sha256": DIGEST, "bytes": 2},
}


def manifest(**changes: Any) -> Manifest:
    tensors = {"b": {"dtype": "float32", "shape": [3]}}
    return Manifest.model_validate(
        {**dict(description()), "tensors": tensors, "files": FILES, **changes}
    )


def stored() -> dict[str, Any]:
    """The members of a stored manifest without the checksum."""
    members: dict[str, Any] = json.loads(manifest().to_bytes())
    del members["checksum"]
    return members


text = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=20)
number = st.floats(allow_nan=False, allow_infinity=False)
count = st.integers(0, 10**12)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | number | text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=8,
)
share = st.floats(0, 1)
shapes = st.lists(count, max_size=3).map(tuple)
alarm_line = st.builds(AlarmLine, intercept=number, log_count=number)
alarm_lines = st.builds(AlarmLines, low=alarm_line, medium=alarm_line, high=alarm_line)
count_slopes = st.builds(CountSlope, **dict.fromkeys(CountSlope.model_fields, number))
weight = st.floats(0, 1e9)
place_fits = st.builds(
    PlaceFit, relation=weight, counts=weight, intercept=number, slope=st.floats(1e-9, 1e9)
)
judgements = st.builds(
    Judgement, **dict.fromkeys({*Judgement.model_fields} - {"lines"}, number), lines=alarm_lines
)
changes = st.fixed_dictionaries(
    {},
    optional={
        "version": st.tuples(count.filter(lambda n: n < 10**9), st.just(0), st.just(7)).map(
            lambda v: ".".join(map(str, v))
        ),
        "created": st.datetimes(timezones=st.timezones()),
        "training": st.dictionaries(text, json_values, max_size=4),
        "terms": text,
        "libraries": st.dictionaries(text, text, max_size=3),
        "calibration": st.builds(
            Calibration,
            coverage=share,
            missing=count_slopes,
            popularity=st.just(()) | st.tuples(number, number, number),
            popularity_weight=share,
            outlier=count_slopes,
            outlier_lines=alarm_lines,
            misplaced=st.builds(Misplaced, **dict.fromkeys(KINDS, st.none() | judgements)),
            at=st.tuples(*[place_fits] * 5),
            **dict.fromkeys(PAIR_CALIBRATIONS, st.tuples(*[count_slopes] * 5)),
        ),
        "tensors": st.dictionaries(
            text,
            st.builds(TensorEntry, dtype=st.sampled_from(["float16", "int64"]), shape=shapes),
            max_size=3,
        ),
    },
)


@given(changes)
def test_reads_back_as_written(change: dict[str, Any]) -> None:
    written = manifest(**change)
    data = written.to_bytes()
    read = Manifest.from_bytes(data)
    assert read == written
    assert read.to_bytes() == data
    assert json.loads(data)["format"] == 8


@pytest.mark.parametrize("value", [7, 9, 8.0, "8", None, True])
def test_refuses_another_format(value: object) -> None:
    body = json.dumps(stored() | {"format": value}).encode()
    # A later format may end in another way, so the format is read before the checksum.
    for data in (resign(body), body):
        with pytest.raises(ArtifactError, match=r"unknown_format.*publish the model again"):
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
        (resign(b'{"format": 8, nonsense}'), "invalid_manifest"),
        (b'{"format": 8}', "invalid_manifest"),
        (resign(b'{"format": 8}'), "invalid_manifest"),
    ],
)
def test_refuses_malformed_manifests(data: bytes, code: str) -> None:
    with refused(code):
        Manifest.from_bytes(data)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("surplus", 1),
        ("vocabulary.surplus", 1),
        ("vocabulary.objects.0.surplus", 1),
        ("calibration.outlier.surplus", 1),
        ("tensors.b.surplus", 1),
        ("name", "../up"),
        ("name", "Upper"),
        ("name", "a\n"),
        ("version", "1.0"),
        ("version", "01.0.0"),
        ("version", "1.0.0\n"),
        ("created", "2020-02-02T20:20:20"),  # no time zone
        ("created", "yesterday"),
        ("spec", None),
        ("spec.V", 4),
        ("spec.A", 2),
        ("spec.C", 5),
        ("spec.profiles", 1),
        ("vocabulary.profiles", ["homes"]),
        ("vocabulary.relations", ["left", "front", "above", "on-top"]),
        ("vocabulary.objects.1.label", "beds"),  # the plural of another one
        ("vocabulary.objects.0.size", [1.0, 2.0]),
        ("vocabulary.objects.0.size", [1.0, 2.0, -3.0]),
        ("calibration.relation", []),
        ("calibration.at", []),
        ("calibration.at.0.slope", 0),
        ("calibration.at.0.relation", -1),
        ("calibration.at.0.counts", math.nan),
        ("calibration.asked_place", []),  # of an older format
        ("calibration.placed", {}),
        ("calibration.coverage", 1.5),
        ("calibration.popularity", [math.inf]),
        ("calibration.evidence", {"poses_on_objects": 1.0}),  # of an older format
        ("calibration.misplaced.under.lines", None),
        ("calibration.misplaced.stand.stand", math.inf),
        ("calibration.misplaced.beside", None),
        ("calibration.outlier_lines.low.intercept", math.inf),
        ("calibration.outlier_lines", None),  # the fit needs its lines
        ("calibration.outlier.slope", math.nan),
        ("calibration.outlier", None),  # without a fit, there are no lines
        ("training.rate", math.nan),
        ("data.0.digest", "xyz"),
        ("data.0.scenes", -1),
        ("data.0.research_only", None),
        ("metrics.0.low", 0.7),  # above high
        ("metrics.0.n", 0),
        ("metrics.0.value", math.nan),
        ("terms", ""),
        ("examples", [{"name": "a", "scene": {"objects": ["bed"], "model": "other"}}]),
        ("examples", [{"name": "a", "scene": {"objects": ["bed"]}}] * 9),
        ("tensors.b.dtype", "object"),
        ("tensors.b.shape", [-1]),
        ("files", {}),
        ("files", {**FILES, "model.pkl": FILES["card.md"]}),
        ("files", {**FILES, "../card.md": FILES["card.md"]}),
    ],
)
def test_refuses_a_field_that_does_not_fit(path: str, value: object) -> None:
    members = stored()
    target: Any = members
    *outer, last = path.split(".")
    for step in outer:
        target = target[int(step) if step.isdigit() else step]
    target[last] = value
    with refused("invalid_manifest"):
        Manifest.from_bytes(resign(json.dumps(members).encode()))


def test_refuses_a_missing_field() -> None:
    for missing in {*Manifest.model_fields} - {"examples", "format"}:
        members = stored()
        del members[missing]
        with pytest.raises(ArtifactError, match=f"invalid_manifest.*{missing}"):
            Manifest.from_bytes(resign(json.dumps(members).encode()))


def test_examples_are_read_back() -> None:
    example = {"name": "A room", "scene": {"objects": ["bed", {"label": "desk lamp", "id": "a"}]}}
    described = manifest(examples=[example])
    read = Manifest.from_bytes(described.to_bytes())
    assert read == described
    assert read.examples[0].request() == {
        "objects": [{"label": "bed"}, {"label": "desk lamp", "id": "a"}]
    }
    assert Manifest.from_bytes(manifest().to_bytes()).examples == ()


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


def test_neutral_calibration_changes_nothing() -> None:
    neutral = Calibration.neutral(5)
    assert neutral.relation == (CountSlope(intercept=0, slope=1, log_count=0),) * 5
    assert neutral.missing == CountSlope(intercept=0, slope=1, log_count=0)
    assert (neutral.popularity, neutral.popularity_weight) == ((), 0)
    assert neutral.at == (PlaceFit(relation=1, counts=0, intercept=0, slope=1),) * 5
    assert neutral.outlier is None
    assert not neutral.misplaced.judges_relations


def test_a_vocabulary_is_kept_whole() -> None:
    entry = VocabularyEntry.of(VOCABULARY)
    assert entry.vocabulary() == VOCABULARY
    assert entry.relations == CANONICAL
    assert VocabularyEntry.of(VOCABULARY, 2).relations == CANONICAL[:2]
    assert VocabularyEntry.of(VOCABULARY, 2, ("homes",)).profiles == ("homes",)
