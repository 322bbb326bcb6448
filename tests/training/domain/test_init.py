"""`init` on files, as a user meets it."""

from __future__ import annotations

import gzip
import json
import math
from dataclasses import replace

import pytest

from tests.training.commands import invoke
from tests.training.domain.scenes import scene
from training.datasets import generate_rooms
from training.datasets.jsonl import write_jsonl
from training.datasets.rooms import DOMAINS
from training.domain.proposal import propose
from training.fit.configuration import ConfigError
from training.runs.config_files import data_folder, load_config
from training.runs.pipeline import prepare

SCENES = generate_rooms(80, 0, DOMAINS["workplaces"])


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "scenes.jsonl"
    write_jsonl(SCENES, path)
    return path


def test_a_proposed_configuration_can_be_trained(file, tmp_path) -> None:
    folder, report = tmp_path / "lab", tmp_path / "report.json"
    output = invoke("init", "lab", file, "--output", folder, "--terms", "ours", "--json", report)
    assert "train" in output
    config = load_config(str(folder))
    assert config == load_config(str(folder / "lab.toml"))
    assert config.data.terms == "ours"
    scenes = prepare(config, data_folder(str(folder), config))
    assert sum(map(len, scenes.parts.values())) == 80
    assert all(scenes.parts.values())
    values = json.loads(report.read_text())
    assert values["parts"] == {part: len(some) for part, some in scenes.parts.items()}
    assert [entry["label"] for entry in values["vocabulary"]["objects"]] == list(
        scenes.vocabulary.labels
    )
    assert values["facts"]["shares"]["positions"] == 1.0
    assert all("." in name for name in values["reasons"])
    assert values["warning"] == ""
    assert values["test_groups"] >= 6


def test_an_edited_vocabulary_is_used(file, tmp_path) -> None:
    folder = tmp_path / "lab"
    invoke("init", "lab", file, "--output", folder)
    path = folder / "vocabulary.json"
    values = json.loads(path.read_text())
    gone = values["objects"].pop(0)["label"]
    path.write_text(json.dumps(values))
    config = load_config(str(folder))
    assert prepare(config, folder).vocabulary.index(gone) is None
    # A built-in synonym becomes a class, and another class becomes an alias. The scenes say "lab
    # bench", so this is the name of the class, and its curated name "table" is an alias.
    bench = next(entry for entry in values["objects"] if entry["label"] == "lab bench")
    bench["aliases"].remove("table")
    merged = values["objects"].pop(values["objects"][0] is bench)["label"]
    bench["aliases"].append(merged)
    path.write_text(json.dumps(values | {"objects": [*values["objects"], {"label": "table"}]}))
    vocabulary = prepare(config, folder).vocabulary
    assert vocabulary.index(merged) == vocabulary.index("lab bench")
    assert vocabulary.labels[vocabulary.index("table")] == "table"
    path.write_text("{}")
    with pytest.raises(ConfigError, match=r"vocabulary\.json cannot be used"):
        prepare(config, folder)


def test_nothing_is_overwritten_silently(file, tmp_path) -> None:
    folder = tmp_path / "lab"
    invoke("init", "lab", file, "--output", folder)
    (folder / "lab.toml").write_text("mine")
    assert "--force" in invoke("init", "lab", file, "--output", folder, code=1)
    assert (folder / "lab.toml").read_text() == "mine"
    invoke("init", "lab", file, "--output", folder, "--force")
    assert "[machine]" in (folder / "lab.toml").read_text()
    # A file with another ending is copied as jsonl.
    scenes, copy = tmp_path / "rec.dat", tmp_path / "other" / "rec.jsonl"
    scenes.write_text(file.read_text())
    copy.parent.mkdir()
    copy.write_text("mine")
    command = ("init", "lab", scenes, "--format", "jsonl", "--output", copy.parent)
    assert "--force" in invoke(*command, code=1)
    assert [path.read_text() for path in copy.parent.iterdir()] == ["mine"]


def test_every_bad_line_is_named_up_to_a_bound(tmp_path) -> None:
    good = [
        json.dumps({"scene_id": str(k), "objects": [{"id": 0, "label": "cup"}]}) for k in range(3)
    ]
    bad = [
        "{",
        json.dumps({"scene_id": "x", "objects": [{"id": 0}]}),
        json.dumps({"scene_id": "y", "objects": [], "relations": [[0, "left", 7]]}),
        good[0],
    ]
    path = tmp_path / "scenes.jsonl"
    path.write_text("\n".join([*good, *bad, *["[]"] * 30]))
    output = invoke("init", "lab", path, "--output", tmp_path / "lab", code=1)
    assert "34 lines are not scenes" in output
    for line, reason in (
        (4, "not JSON"), (5, "lacks label"), (6, "names an object that is not in the scene"),
        (7, "is on line 1 already"),
    ):  # fmt: skip
        assert f"line {line}: " in output
        assert reason in output
    assert "line 23" in output
    assert "line 24" not in output
    assert "and 14 more" in output
    assert not (tmp_path / "lab").exists()
    path.write_text("[]")
    assert "1 line is not a scene;" in invoke("init", "lab", path, code=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Lab One",), "lower-case words"),
        (("indoor-triway",), "shipped configuration"),
        (("lab", "--format", "csv"), "unknown format"),
    ],
)
def test_invalid_arguments_are_refused(file, tmp_path, arguments, message) -> None:
    name, *options = arguments
    assert message in invoke("init", name, file, "--output", tmp_path / "o", *options, code=1)
    assert not (tmp_path / "o").exists()


def test_too_few_scenes_are_told(tmp_path) -> None:
    path = tmp_path / "scenes.jsonl"
    write_jsonl(SCENES[:19], path)
    output = invoke("init", "lab", path, "--output", tmp_path / "o", code=1)
    assert "19 scenes are too few: from fewer than 20" in output
    write_jsonl([replace(scene, group="one place") for scene in SCENES], path)
    assert "cannot be split" in invoke("init", "lab", path, "--output", tmp_path / "o", code=1)
    path.write_text("")
    assert "contains no scene" in invoke("init", "lab", path, "--output", tmp_path / "o", code=1)
    write_jsonl(SCENES[:40], path)
    output = invoke("init", "lab", path, "--output", tmp_path / "o")
    assert "warning: 40 scenes of 22 groups are few" in output


def test_a_name_that_tells_no_format_is_copied_as_one_that_does(tmp_path) -> None:
    path, folder = tmp_path / "recorded.txt", tmp_path / "lab"
    write_jsonl(SCENES, path)
    assert "fits no known format" in invoke("init", "lab", path, "--output", folder, code=1)
    invoke("init", "lab", path, "--format", "jsonl", "--output", folder)
    config = load_config(str(folder))
    assert config.data.sources == ("recorded.jsonl",)
    assert prepare(config, folder).counts == {"recorded": 80}


def test_several_gzipped_files_are_sources_of_their_own(tmp_path) -> None:
    for number, some in enumerate((SCENES[:40], SCENES[40:])):
        write_jsonl(some, tmp_path / f"day{number}.jsonl.gz")
    with gzip.open(tmp_path / "day0.jsonl.gz") as file:
        assert json.loads(file.readline())["scene_id"] == SCENES[0].scene_id
    invoke(
        *("init", "lab", tmp_path / "day0.jsonl.gz", tmp_path / "day1.jsonl.gz"),
        *("--output", tmp_path / "lab"),
    )
    config = load_config(str(tmp_path / "lab"))
    assert prepare(config, tmp_path / "lab").counts == {"day0": 40, "day1": 40}


def test_objects_alone_are_for_a_machine_without_relations() -> None:
    bare = [
        replace(
            scene,
            viewer_frame=False,
            objects=tuple(
                replace(thing, position=None, size=None, supported_by=None)
                for thing in scene.objects
            ),
        )
        for scene in SCENES
    ]
    proposal = propose("lab", bare, ["scenes.jsonl"])
    assert proposal.config.machine.variant == "rbm"
    assert propose("lab", SCENES, ["scenes.jsonl"]).config.machine.variant == "triway"


def test_a_slip_becomes_an_alias_and_a_rare_label_no_class() -> None:
    scenes = [
        scene(f"s{k}", "oscilloscope", "workbench", "multimeter", *(["unicorn"] if k == 0 else []))
        for k in range(60)
    ] + [scene("slip", "osciloscope", "workbench", "multimeter")]
    proposal = propose("lab", scenes, ["scenes.jsonl"])
    vocabulary = proposal.vocabulary
    assert vocabulary.index("osciloscope") == vocabulary.index("oscilloscope") is not None
    assert proposal.dropped == (("unicorn", 1, f"under {proposal.minimum} mentions"),)
    assert proposal.covered[8][0] == 3


@pytest.mark.parametrize(("scenes", "states"), [(80, 8), (1500, 32)])
def test_many_scenes_get_a_larger_machine(scenes, states) -> None:
    rooms = generate_rooms(scenes, 0, DOMAINS["workplaces"])
    proposal = propose("lab", rooms, ["scenes.jsonl"])
    config, n = proposal.config, proposal.parts["train"]
    assert (config.machine.states, config.machine.coupled) == (states, False)
    updates = config.relations.epochs * math.ceil(n / config.relations.batch_size)
    assert 200 <= updates <= 900
    assert 8 <= math.ceil(n / config.relations.batch_size) <= 25


def test_kinds_follow_their_class_to_its_most_frequent_name() -> None:
    scenes = [scene(f"s{k}", "cutlery", "spoon", "plate") for k in range(40)]
    vocabulary = propose("lab", scenes, ["scenes.jsonl"]).vocabulary
    cutlery, spoon = vocabulary.index("cutlery"), vocabulary.index("spoon")
    assert vocabulary.labels[cutlery] == "cutlery"
    assert vocabulary.index("utensil") == cutlery
    assert vocabulary.parents[spoon] == cutlery


def test_more_scenes_move_none_to_another_part(tmp_path) -> None:
    path = tmp_path / "scenes.jsonl"
    write_jsonl(SCENES, path)
    invoke("init", "lab", path, "--output", tmp_path / "lab")
    config = load_config(str(tmp_path / "lab"))

    def parts() -> dict[str, str]:
        found = prepare(config, tmp_path / "lab").parts
        return {scene.scene_id: part for part, some in found.items() for scene in some}

    before = parts()
    write_jsonl(generate_rooms(120, 0, DOMAINS["workplaces"]), path)
    after = parts()
    assert len(after) == 120
    assert before.items() <= after.items()
