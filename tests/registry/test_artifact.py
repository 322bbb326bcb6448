"""One artifact: it is read as it was written, and every damage is an error."""

import os
import pickle
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from app.inference.weights import layout
from app.registry import ArtifactError, load_artifact, write_artifact
from app.registry.card import render_card
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, TensorEntry
from tests.registry.small_artifacts import (
    DATA,
    FIGURE,
    SPECS,
    VOCABULARY,
    description,
    replace_file,
    rewrite_manifest,
    state,
)
from training.machines import VARIANTS, MachineSpec, build

FILES = (WEIGHTS, MANIFEST, CARD)


@pytest.fixture
def written(tmp_path: Path) -> Path:
    directory = tmp_path / "artifact"
    write_artifact(directory, description(), state())
    return directory


def refusal(directory: Path) -> ArtifactError:
    with pytest.raises(ArtifactError) as refused:
        load_artifact(directory)
    assert str(directory.parent) not in str(refused.value), "a reason shows no path"
    return refused.value


@pytest.mark.parametrize("variant", SPECS)
def test_round_trip_is_exact_in_float32(variant: str, tmp_path: Path) -> None:
    weights = state(variant)
    saying = description(variant=variant)
    manifest = write_artifact(tmp_path / "a", saying, weights)
    read = load_artifact(tmp_path / "a")
    assert read.manifest == manifest
    assert read.model.spec == MachineSpec.from_dict(SPECS[variant])
    assert read.model.vocabulary == VOCABULARY
    assert read.model.calibration == saying.calibration
    assert read.card == (tmp_path / "a" / CARD).read_text()
    assert read.path == tmp_path / "a"
    loaded = read.model.weights.arrays
    assert loaded.keys() == weights.keys()
    for name, array in weights.items():
        assert np.array_equal(loaded[name], array), name
        assert loaded[name].dtype == array.dtype, name


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    "more", [{}, {"C": 3, "N": 4, "G": 1}, {"states": 3, "C": 3, "profiles": 2, "coupled": True}]
)
def test_the_layout_is_that_of_the_machines(variant: str, more: dict[str, Any]) -> None:
    sizes = {name: n for name, n in more.items() if name != "G" or variant == "triway"}
    spec = MachineSpec(variant, V=40, A=4, units=5, K=2, T=3, **sizes)
    state = build(spec).state_dict()
    kinds = {torch.float32: float, torch.int32: int}
    assert layout(spec) == {name: (kinds[t.dtype], tuple(t.shape)) for name, t in state.items()}


@pytest.mark.parametrize("name", ["W", "Q"])
def test_too_large_weights_are_not_served(name: str, tmp_path: Path) -> None:
    weights = state("triway")
    weights[name][0, 1] = -40.0
    write_artifact(tmp_path / "a", description(variant="triway"), weights)
    load_artifact(tmp_path / "a")
    weights[name][0, 1] = -40.1
    write_artifact(tmp_path / "b", description(variant="triway"), weights)
    assert refusal(tmp_path / "b").code == "unsupported"


@pytest.mark.parametrize("entry", [(0, 1), (2, 2)])
def test_refuses_couplings_that_no_machine_has(entry: tuple[int, int], tmp_path: Path) -> None:
    weights = state("triway")
    weights["L"][entry] += 1.0
    write_artifact(tmp_path / "a", description(variant="triway"), weights)
    assert refusal(tmp_path / "a").code == "invalid_tensor"


def test_half_precision_keeps_biases_and_integers_whole(tmp_path: Path) -> None:
    weights = state()
    manifest = write_artifact(tmp_path / "a", description(), weights, storage_dtype="float16")
    loaded = load_artifact(tmp_path / "a").model.weights
    for name, array in weights.items():
        stored = manifest.tensors[name].dtype
        if array.dtype == np.float32 and array.ndim > 1:
            assert stored == "float16"
            assert loaded[name].dtype == np.float32
            assert np.array_equal(loaded[name], array.astype(np.float16)), name
        else:
            assert stored == array.dtype.name
            assert np.array_equal(loaded[name], array), name


def test_the_same_content_is_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_artifact(tmp_path / name, description(), dict(reversed(state().items())))
    for file in FILES:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert load_artifact(tmp_path / "a").digest == load_artifact(tmp_path / "b").digest


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 70_000.0])
def test_refuses_to_write_numbers_that_the_file_cannot_hold(value: float, tmp_path: Path) -> None:
    weights = state()
    weights["W"][1, 2] = value
    with pytest.raises(ArtifactError, match=r"not_finite.*'W'.*float16"):
        write_artifact(tmp_path / "a", description(), weights, storage_dtype="float16")
    assert not (tmp_path / "a").exists()
    if np.isfinite(value):
        write_artifact(tmp_path / "a", description(), weights)


@pytest.mark.parametrize("file", FILES)
def test_refuses_a_file_that_is_cut_or_longer_or_missing(file: str, written: Path) -> None:
    whole = (written / file).read_bytes()
    lengths = {0, 1, 7, 8, 9, len(whole) // 2, len(whole) - 2, len(whole) - 1}
    for length in sorted(lengths):
        (written / file).write_bytes(whole[:length])
        error = refusal(written)
        # A manifest without its last newline is whole JSON: it is told by the missing trailer.
        last = file == MANIFEST and length == len(whole) - 1
        assert error.code == ("invalid_manifest" if last else "truncated"), length
        assert file in error.reason
    (written / file).write_bytes(whole + b"\n")
    assert refusal(written).code in {"checksum_mismatch", "invalid_manifest"}
    (written / file).unlink()
    error = refusal(written)
    assert (error.code, file in error.reason) == ("missing_file", True)


@pytest.mark.parametrize("file", FILES)
def test_refuses_a_flipped_byte(file: str, written: Path) -> None:
    whole = (written / file).read_bytes()
    generator = random.Random(0)
    offsets = {0, 7, 8, len(whole) - 1} | set(generator.sample(range(len(whole)), 60))
    for offset in sorted(offsets):
        spoilt = bytearray(whole)
        spoilt[offset] ^= 1 << generator.randrange(8)
        (written / file).write_bytes(spoilt)
        error = refusal(written)
        expected = {"checksum_mismatch"}
        if file == MANIFEST and offset >= len(whole) - 84:  # in the line of its checksum, or before
            expected |= {"truncated", "invalid_manifest"}
        assert error.code in expected, offset


@pytest.mark.parametrize("name", ["model.pt", "weights.pkl", ".hidden", "model.safetensors.bak"])
def test_refuses_an_unexpected_file(name: str, written: Path) -> None:
    (written / name).write_bytes(pickle.dumps({"b": [0.0]}))
    error = refusal(written)
    assert (error.code, name in error.reason) == ("unexpected_file", True)
    for number in range(1000):
        (written / f"x{number:0200}").touch()
    assert len(refusal(written).reason) < 2000


@pytest.mark.parametrize("kind", ["link", "folder", "pipe"])
def test_refuses_links_folders_and_pipes(kind: str, written: Path, tmp_path: Path) -> None:
    make: dict[str, Any] = {"folder": Path.mkdir, "pipe": os.mkfifo}
    card = (written / CARD).rename(tmp_path / "moved.md")
    make.get(kind, lambda place: place.symlink_to(card))(written / CARD)
    before = sorted(Path("/proc/self/fd").iterdir())
    assert refusal(written).code == "unreadable"
    assert sorted(Path("/proc/self/fd").iterdir()) == before, "no descriptor stays open"


@pytest.mark.parametrize(
    "data",
    [
        pickle.dumps({"b": [0.0, 0.0, 0.0]}),
        b"",
        b"\0" * 64,
        (2**63).to_bytes(8, "little") + b"{}",
        (10**9).to_bytes(8, "little") + b"{}",
        save({"b": np.zeros(3, np.float32)})[:-1],
        save({"b": np.zeros(3, np.float32)}) + b"\0",
    ],
)
def test_refuses_malformed_weights_files(data: bytes, written: Path) -> None:
    replace_file(written, WEIGHTS, data)
    assert refusal(written).code == "not_safetensors"


def spoil(written: Path, change: Callable[[dict[str, Any]], object]) -> ArtifactError:
    """Store other tensors, and let manifest and checksums agree with them."""
    weights: dict[str, Any] = state()
    change(weights)
    replace_file(written, WEIGHTS, save(weights))
    entries = {k: {"dtype": one.dtype.name, "shape": list(one.shape)} for k, one in weights.items()}
    rewrite_manifest(written, lambda members: members.update(tensors=entries))
    return refusal(written)


NOT_FINITE = [
    (lambda t, name=name, value=value: t[name].__setitem__(-1, value), name, "not_finite")
    for name in ("b", "U")
    for value in (np.nan, np.inf, -np.inf)
]
OUT_OF_RANGE = [
    (lambda t, row=row: t["triples"].__setitem__(1, row), "triples", "invalid_tensor")
    for row in ((5, 0, 0), (0, 3, 0), (0, 0, -1), (0, 0, 1))  # the last one twice
]


@pytest.mark.parametrize(
    ("change", "tensor", "code"),
    [
        (lambda t: t.update(b=np.zeros(4, np.float32)), "b", "wrong_shape"),
        (lambda t: t.update(W=t["W"].T.copy()), "W", "wrong_shape"),
        (lambda t: t.update(extra=np.zeros(1, np.float32)), "extra", "wrong_shape"),
        (lambda t: t.pop("c1"), "c1", "wrong_shape"),
        (lambda t: t.update(triples=t["triples"].astype(np.int64)), "triples", "wrong_shape"),
        (lambda t: t.update(triples=t["triples"].astype(np.float32)), "triples", "wrong_shape"),
        (lambda t: t.update(b=np.zeros(3, np.int32)), "b", "wrong_shape"),
        (lambda t: t.update(b=np.zeros(3, bool)), "b", "wrong_shape"),
        *NOT_FINITE,
        *OUT_OF_RANGE,
    ],
)
def test_refuses_tensors_that_do_not_fit_the_spec(change, tensor, code, written):
    error = spoil(written, change)
    assert (error.code, f"'{tensor}'" in error.reason) == (code, code != "invalid_tensor")


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.update(b={"dtype": "float32", "shape": [4]}),
        lambda t: t.update(b={"dtype": "float16", "shape": [3]}),
        lambda t: t.pop("b"),
        lambda t: t.update(extra={"dtype": "float32", "shape": []}),
    ],
)
def test_refuses_tensors_that_the_manifest_does_not_promise(change, written):
    rewrite_manifest(written, lambda members: change(members["tensors"]))
    assert refusal(written).code == "wrong_shape"


@pytest.mark.parametrize("dtype", [np.float64, np.uint8])
def test_refuses_dtypes_that_artifacts_do_not_hold(dtype: Any, written: Path) -> None:
    replace_file(written, WEIGHTS, save({**state(), "b": np.zeros(3, dtype)}))
    assert refusal(written).code == "wrong_shape"


@pytest.mark.parametrize(
    "change",
    [
        {"variant": "transformer"},
        {"surplus": 1},
        {"units": -5},
        {"states": 1},
        {"G": 1},  # an RBM has none
        {"profiles": 1},  # the vocabulary has none
        {"units": 10**15},  # beyond any memory: must be refused before it is allocated
        {"T": 10**18},
    ],
)
def test_refuses_a_spec_that_no_machine_has(change: dict[str, Any], written: Path) -> None:
    rewrite_manifest(written, lambda members: members["spec"].update(change))
    assert refusal(written).code in {"invalid_manifest", "wrong_shape"}


TENSORS = {
    "W": TensorEntry(dtype="float16", shape=(3, 5)),
    "triples": TensorEntry(dtype="int32", shape=(2, 3)),
}


def source(name: str, **changes: Any) -> dict[str, Any]:
    return DATA | {"scenes": 8133, "terms": f"terms of {name}", "source": name} | changes


def card(**changes: Any) -> str:
    return render_card(description(**changes), TENSORS)


def test_names_data_terms_sizes_and_limits() -> None:
    spec = SPECS["triway"] | {"G": 8, "N": 1024, "T": 17969}
    page = card(variant="triway", spec=spec, data=[source("rooms")])
    assert page.startswith("# tiny 1.0.0\n")
    for text in (
        *("| rooms | 8,133 |  | terms of rooms |", "Terms of the weights: Apache-2.0"),
        *("(stored as float16, int32)", "3, of which 2 may be proposed", "bedroom, office"),
        *("2 units of 4 states", "17,969 triples", "1,024, where chains start", "homes, shops"),
        *("\n## Intended use\n", "\n## Limits\n"),
    ):
        assert text in page


def test_states_the_shares_of_written_and_of_seen_scenes() -> None:
    written, seen = source("lists", share=0.4, written=True), source("rooms", share=0.6)
    page = card(data=[written, seen])
    assert "written places have 40.0 % of the weight" in page
    assert "seen scenes have 60.0 %" in page
    assert "| rooms | 8,133 | 60.0 % | terms of rooms |" in page
    # An adapted model adds scenes of its own, whose share is unknown.
    assert "of the weight of all" not in card(data=[written, seen, source("home")])


def test_says_who_may_use_it_before_any_table() -> None:
    free, bound = source("free"), source("bound", research_only=True)
    freely = card(data=[free], terms="With attribution.")
    assert "- A commercial robot may use the weights under their terms: With attribution." in freely
    warned = card(data=[free, bound])
    text = "research only, because the terms of bound exclude commercial robots"
    assert 0 < warned.index(text) < warned.index("## Model")
    assert "may use the weights" not in warned
    assert "second training run" in card(training={"measured_split": "group"})


def test_metrics_have_a_column_for_each_source() -> None:
    """A metric without a value of a source leaves its cell empty."""
    measured = [("T1", "R", "a"), ("T2", "MRR", "a"), ("T2", "MRR", "b"), ("T4", "MMD", "pooled")]
    page = card(metrics=[{"task": t, "metric": m, "source": s} | FIGURE for t, m, s in measured])
    cell = "0.500 [0.400, 0.600]"
    lines = page.splitlines()
    first = lines.index("| Task | Metric | a | b | pooled |")
    assert lines[first + 2 : first + 5] == [
        f"| T1 | R | {cell} |  |  |",
        f"| T2 | MRR | {cell} | {cell} |  |",
        f"| T4 | MMD |  |  | {cell} |",
    ]


def test_markdown_in_a_source_is_escaped() -> None:
    page = card(data=[source("a|b # Heading", research_only=True)])
    assert "a\\|b # Heading" in page
