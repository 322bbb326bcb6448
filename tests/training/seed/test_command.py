"""`python -m training seed` on small files of scenes, and the scenes that it reads."""

from __future__ import annotations

import json
from collections import Counter

import pytest

from tests.training.commands import invoke
from training.datasets import AnnotatedObject, AnnotatedScene, generate_rooms
from training.datasets.jsonl import write_jsonl
from training.seed import command
from training.seed.machines import VARIANTS
from training.seed.scenes import SPLITS, read_material


def scene(number, relations):
    objects = tuple(AnnotatedObject(label, label) for label in ("desk", "lamp", "floor"))
    return AnnotatedScene(f"s{number}", "lab", f"g{number // 4}", "office", objects, relations)


def test_scenes_are_split_and_encoded(tmp_path):
    listed = ((1, "on-top", 0), (0, "on-top", 2))
    scenes = [scene(k, listed if k % 2 else None) for k in range(80)]
    write_jsonl(scenes, tmp_path / "lab.jsonl")
    materials = read_material(str(tmp_path / "lab.jsonl"), tmp_path, tuple(SPLITS))
    for material in materials.values():
        labels = [entry.label for entry in material.vocabulary.objects]
        triples = {(labels[i], labels[j]) for _, i, j in material.triples.tolist()}
        # The floor is an ordinary object.
        assert triples == {("lamp", "desk"), ("desk", "floor")}
        parts = material.train, material.validation, material.test
        sizes = [len(part) for part in parts]
        assert sizes == pytest.approx([48, 8, 24], abs=4)
        for part in parts:
            assert part.v.sum(1).tolist() == [3] * len(part)
            assert part.r.sum(1).tolist() == part.labelled.tolist()
            assert part.labelled.tolist() == [2 * flag for flag in part.annotated.tolist()]
    assert Counter(material.digest for material in materials.values()).most_common()[0][1] == 1


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished command: (its arguments, the folder of its results)."""
    folder = tmp_path_factory.mktemp("seed")
    write_jsonl(generate_rooms(60, seed=0), folder / "rooms.jsonl")
    arguments = ("seed", folder / "rooms.jsonl", "--out", folder / "out", "--seeds", 2, "--epochs")
    invoke(*arguments, 2)
    return arguments, folder / "out" / "rooms"


@pytest.mark.slow
def test_the_page_has_every_row_and_the_figures_of_the_paper(finished):
    results = json.loads((finished[1] / "results.json").read_text())
    assert set(results["splits"]) == set(SPLITS)
    for result in results["splits"].values():
        assert set(result["references"]) == {"frequency", "nothing"}
        assert {name: len(runs) for name, runs in result["machines"].items()} == dict.fromkeys(
            VARIANTS, 2
        )
    text = (finished[1] / "results.md").read_text()
    rows = {line.split(" | ")[0].strip("| ") for line in text.splitlines() if line[:1] == "|"}
    for row in (
        "T1 precision", "T2 false objects, relations left", "T3 error / V", "T3 error / objects",
        "T4 objects a scene, others zero", "annealed: T1 on", "E objects, epoch 1",
        "E relations, last epoch",
    ):  # fmt: skip
        assert row in rows
    assert "0.0560 / 0.1418 / 0.2335" in text


@pytest.mark.slow
def test_finished_machines_are_kept(finished, monkeypatch):
    """Ctrl-C stops the command, and the next call trains only the machines without a file."""
    arguments, folder = finished
    before = (folder / "results.md").read_text()
    lost = [folder / "scenes" / "gbm-seed-1.json", folder / "groups" / "rbm-seed-0.json"]
    for path in lost:
        path.unlink()
    trained = []

    def interrupted(*values):
        if trained:
            raise KeyboardInterrupt
        trained.append(values)
        return train(*values)

    train = command.train
    monkeypatch.setattr(command, "train", interrupted)
    assert "run the same command again" in invoke(*arguments, 2, code=130)
    assert [path.exists() for path in lost] == [True, False]
    monkeypatch.setattr(command, "train", train)
    invoke(*arguments, 2)
    kept = [line for line in before.splitlines() if "seconds" not in line]
    after = (folder / "results.md").read_text().splitlines()
    assert [line for line in after if "seconds" not in line] == kept


@pytest.mark.slow
def test_errors_are_named(finished, tmp_path):
    arguments, _ = finished
    assert "other scenes or settings" in invoke(*arguments, 3, code=1)
    assert "cannot be read" in invoke("seed", "nowhere", "--data", tmp_path, code=1)
