import json
import subprocess
import sys
import time
from collections import Counter

import pytest
import torch

from tests.conftest import REPOSITORY, run_program
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
    write_jsonl([scene(k, listed if k % 2 else None) for k in range(80)], tmp_path / "lab.jsonl")
    materials = read_material(str(tmp_path / "lab.jsonl"), tmp_path)
    for material in materials.values():
        labels = [entry.label for entry in material.vocabulary.objects]
        triples = {(labels[i], labels[j]) for _, i, j in material.triples.tolist()}
        # The floor is an ordinary object.
        assert triples == {("lamp", "desk"), ("desk", "floor")}
        parts = material.train, material.validation, material.test
        assert [len(part) for part in parts] == pytest.approx([48, 8, 24], abs=4)
        for part in parts:
            assert part.v.sum(1).tolist() == [3] * len(part)
            assert part.r.sum(1).tolist() == part.labelled.tolist()
            assert part.labelled.tolist() == [2 * flag for flag in part.annotated.tolist()]
    assert Counter(material.digest for material in materials.values()).most_common()[0][1] == 1


def test_inside_is_left_out(tmp_path):
    listed = ((1, "on-top", 0), (1, "left", 2))
    for name, inside in (("with", ((1, "inside", 0), (2, "contains", 1))), ("without", ())):
        scenes = [scene(k, (*listed, *inside) if k % 2 else inside) for k in range(40)]
        write_jsonl(scenes, tmp_path / f"{name}.jsonl")
    files = [tmp_path / f"{name}.jsonl" for name in ("with", "without")]
    read = [read_material(str(file), tmp_path) for file in files]
    for split in SPLITS:
        first, second = (materials[split] for materials in read)
        assert first.digest == second.digest
        assert torch.equal(first.triples, second.triples)
        assert set(first.triples[:, 0].tolist()) == {0, 2}
        for part in ("train", "validation", "test"):
            mine, other = getattr(first, part), getattr(second, part)
            assert all(map(torch.equal, vars(mine).values(), vars(other).values()))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seed")
    write_jsonl(generate_rooms(60, seed=0), folder / "rooms.jsonl")
    arguments = ("seed", folder / "rooms.jsonl", "--seeds", 2, "--epochs", 2, "--workers")
    return arguments, folder / "out" / "rooms", invoke(*arguments, 1, "--out", folder / "out")


@pytest.mark.slow
def test_the_page_has_every_row_and_the_figures_of_the_paper(finished):
    _, folder, output = finished
    results = json.loads((folder / "results.json").read_text())
    assert set(results["splits"]) == set(SPLITS)
    for result in results["splits"].values():
        assert set(result["references"]) == {"frequency", "nothing"}
        assert {name: len(runs) for name, runs in result["machines"].items()} == dict.fromkeys(
            VARIANTS, 2
        )
    text = (folder / "results.md").read_text()
    assert "0.0560 / 0.1418 / 0.2335" in text
    assert " ".join(text.split()) in output
    assert (folder / "errors.png").read_bytes().startswith(b"\x89PNG")


def without_times(folder):
    runs = {path: json.loads(path.read_text()) for path in folder.glob("*/*.json")}
    for run in runs.values():
        del run["cpu"]
        for epoch in run["history"]:
            del epoch["seconds"]
    return {path.relative_to(folder): run for path, run in runs.items()}


@pytest.mark.slow
def test_a_killed_command_continues_with_equal_figures(finished, tmp_path):
    """Two worker processes give the figures of one, also if the command was killed on the way."""
    arguments, folder, _ = finished
    command = [sys.executable, "-m", "training", *map(str, arguments), "2", "--out", str(tmp_path)]
    process = subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 100
    while not list(tmp_path.glob("*/*/*.json")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*/*.json")}
    assert 0 < len(kept) < len(without_times(folder))
    run_program(*command, timeout=300)
    assert without_times(tmp_path / "rooms") == without_times(folder)
    assert kept == {path: path.stat().st_mtime_ns for path in kept}


@pytest.mark.slow
def test_errors_are_named(finished, tmp_path, monkeypatch):
    arguments, folder, _ = finished
    again = (*arguments, 1, "--out", folder.parent)
    assert "other scenes or settings" in invoke(*again, "--epochs", 3, code=1)
    assert "no such file" in invoke("seed", "nowhere", "--data", tmp_path, code=1)
    large = (*arguments, 1, "--out", tmp_path, "--learning-rate", 1000)
    assert "scenes, rbm, seed 0: training diverged in epoch 1" in invoke(*large, code=1)

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_materials", stopped)
    assert "run the same command again" in invoke(*again, code=130)
