import json
import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from tests.training.commands import init, prepared
from tests.training.scenes import scene
from training.datasets import generate_rooms
from training.datasets.jsonl import write_jsonl
from training.datasets.rooms import DOMAINS
from training.domain.material import Material
from training.domain.proposal import propose
from training.fit.configuration import ConfigError
from training.runs.config_files import load_config
from training.runs.pipeline import prepare

SCENES = generate_rooms(80, 0, DOMAINS["workplaces"])


def of_scenes(scenes: list) -> Material:
    return Material((tuple(scenes),), {}, Counter())


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "scenes.jsonl"
    write_jsonl(SCENES, path)
    return path


@pytest.fixture
def lab(file) -> Path:
    init(file, folder=file.parent / "lab")
    return file.parent / "lab"


def test_a_proposed_configuration_can_be_trained(file, tmp_path) -> None:
    folder = tmp_path / "lab"
    output = init(file, folder=folder, options=("--terms", "ours"))
    assert f"python -m training train {folder}" in output
    config = load_config(str(folder))
    assert config == load_config(str(folder / "lab.toml"))
    assert (config.data.terms, config.data.split) == ("ours", "stable")
    scenes = prepared(folder)
    assert sum(map(len, scenes.parts.values())) == 80
    assert all(scenes.parts.values())
    assert "positions 100%" in output
    assert f"{len(scenes.vocabulary)} classes with at least" in output
    assert "warning" not in output


def test_an_edited_vocabulary_is_used(lab) -> None:
    path, config = lab / "vocabulary.json", load_config(str(lab))
    values = json.loads(path.read_text())
    gone = values["objects"].pop(0)["label"]
    path.write_text(json.dumps(values))
    assert prepare(config, lab).vocabulary.index(gone) is None
    # A built-in synonym becomes a class, and another class becomes an alias. The scenes say "lab
    # bench", so this is the name of the class, and its curated name "table" is an alias.
    bench = next(entry for entry in values["objects"] if entry["label"] == "lab bench")
    bench["aliases"].remove("table")
    merged = values["objects"].pop(values["objects"][0] is bench)["label"]
    bench["aliases"].append(merged)
    path.write_text(json.dumps(values | {"objects": [*values["objects"], {"label": "table"}]}))
    vocabulary = prepare(config, lab).vocabulary
    assert vocabulary.index(merged) == vocabulary.index("lab bench")
    assert vocabulary.labels[vocabulary.index("table")] == "table"
    path.write_text("{}")
    with pytest.raises(ConfigError, match=r"vocabulary\.json cannot be used"):
        prepare(config, lab)
    path.unlink()
    with pytest.raises(ConfigError, match=r"vocabulary\.json: no such file$"):
        prepare(config, lab)


def test_files_are_overwritten_only_with_force(file, lab) -> None:
    (lab / "lab.toml").write_text("mine")
    assert "--force" in init(file, folder=lab, code=1)
    assert (lab / "lab.toml").read_text() == "mine"
    init(file, folder=lab, options=["--force"])
    assert "[machine]" in (lab / "lab.toml").read_text()


def vocabulary(folder: Path) -> dict[str, dict]:
    values = json.loads((folder / "vocabulary.json").read_text())
    return {entry["label"]: entry for entry in values["objects"]}


def edit(folder: Path, entries: list[dict], **others: object) -> str:
    values = json.loads((folder / "vocabulary.json").read_text()) | {"objects": entries} | others
    (folder / "vocabulary.json").write_text(json.dumps(values))
    return json.dumps(values)


def test_an_update_keeps_edits_and_adds_new_files(lab) -> None:
    removed, renamed, merged, flagged, *_ = found = vocabulary(lab).values()
    old = [dict(entry) for entry in (removed, renamed, merged)]
    renamed["label"] = "my thing"
    flagged |= {"anywhere": True, "aliases": [*flagged["aliases"], merged["label"]]}
    entries = [x for x in found if x not in (removed, merged)]
    rooms = {"room_types": ["workshop"], "room_aliases": {"workshop": ["garage"]}}
    edit(lab, entries, **rooms)
    toml = lab / "lab.toml"
    mine = re.sub(r"(?m)^steps = .*", "steps = 7  # mine", toml.read_text())
    toml.write_text(mine)
    (lab / "examples.json").write_text("[]")
    new = [
        scene(f"new-{k}", "unicorn", "Unicorns", old[0]["label"], flagged["label"], room="stable")
        for k in range(20)
    ]
    write_jsonl(new, lab.parent / "new.jsonl")
    output = init(lab.parent / "new.jsonl", folder=lab, options=["--update"])

    after = list(vocabulary(lab).values())
    assert after[: len(entries)] == entries
    assert [entry["label"] for entry in after[len(entries) :]] == ["unicorn"]
    values = json.loads((lab / "vocabulary.json").read_text())
    assert values["room_types"] == ["workshop", "stable"]
    assert values["room_aliases"] == rooms["room_aliases"]
    sources = '["../scenes.jsonl", "../new.jsonl"]'
    assert toml.read_text() == mine.replace('["../scenes.jsonl"]', sources)
    assert (lab / "examples.json").read_text() == "[]"
    assert "mentions: unicorn (40) new room types: stable removed" in output
    kept_out = output.split("not added again: ")[1].split(" new sources: ../new.jsonl")[0]
    assert {f"{entry['label']} (" in kept_out for entry in old[:2]} == {True}
    assert f"{merged['label']} (" not in kept_out
    assert prepared(lab).counts == {"scenes": 80, "new": 20}

    # An added class that the person removes stays removed, too. Nothing else is new.
    text = edit(lab, entries)
    assert "no new classes" in init(lab.parent / "new.jsonl", folder=lab, options=["--update"])
    assert (lab / "vocabulary.json").read_text() == text


def test_an_update_reads_a_file_that_has_grown(file, lab) -> None:
    before = {path.name: path.read_text() for path in lab.iterdir()}
    assert "written: nothing" in init(file, folder=lab, options=["--update"])
    assert {path.name: path.read_text() for path in lab.iterdir()} == before
    new = [scene(f"new-{k}", "unicorn", "lab bench") for k in range(20)]
    write_jsonl([*SCENES, *new], file)
    assert "unicorn (20)" in init(file, folder=lab, options=["--update"])
    assert list(vocabulary(lab))[-1] == "unicorn"
    assert (lab / "lab.toml").read_text() == before["lab.toml"]


@pytest.mark.parametrize(
    ("break_it", "options", "message"),
    [
        (lambda lab: (lab / "lab.toml").unlink(), (), "run init without --update"),
        (lambda lab: (lab / "proposed.json").unlink(), (), "proposed.json is missing"),
        (lambda lab: (lab / "proposed.json").write_text("[]"), (), "proposed.json cannot be used"),
        (lambda lab: (lab / "vocabulary.json").write_text("{}"), (), "objects: Field required"),
        (lambda lab: (lab / "vocabulary.json").write_text("{,"), (), "vocabulary.json cannot be"),
        (lambda lab: (lab / "vocabulary.json").unlink(), (), "vocabulary.json: no such file"),
        (lambda lab: None, ("--force",), "--force cannot be used with it"),
        (lambda lab: None, ("--terms", "x"), "--terms cannot be used with it"),
    ],
)
def test_an_update_without_a_usable_proposal_is_refused(file, lab, break_it, options, message):
    break_it(lab)
    before = {path.name: path.read_text() for path in lab.iterdir()}
    assert message in init(file, folder=lab, options=["--update", *options], code=1)
    assert {path.name: path.read_text() for path in lab.iterdir()} == before


def test_sources_that_cannot_be_edited_are_left_to_the_person(file, lab) -> None:
    toml = lab / "lab.toml"
    toml.write_text(toml.read_text().replace("sources = [", '"sources" = ['))
    write_jsonl(SCENES[:30], other := file.with_name("other.jsonl"))
    other.write_text(other.read_text().replace("rooms-0", "rooms-1"))
    message = 'write sources = ["../scenes.jsonl", "../other.jsonl"] into [data]'
    assert message in init(other, folder=lab, options=["--update"], code=1)


def test_each_invalid_line_is_named_up_to_a_bound(tmp_path) -> None:
    lines = [{"scene_id": k, "objects": [{"id": 0, "label": "cup"}]} for k in "abc"]
    lines += [
        {"scene_id": "x", "objects": [{"id": 0}]},
        {"scene_id": "y", "objects": [], "relations": [[0, "left", 7]]},
        lines[0],
    ]
    path = tmp_path / "scenes.jsonl"
    path.write_text("\n".join([*map(json.dumps, lines), "{", *["[]"] * 30]))
    output = init(path, folder=tmp_path / "lab", code=1)
    assert "scenes.jsonl has 34 errors; nothing was written" in output
    for line, reason in (
        (4, "objects.0.label: Field required"), (5, "names an object that is not in the scene"),
        (6, "is on line 1 already"), (7, "Invalid JSON"), (35, ""),
    ):  # fmt: skip
        assert reason in output.split(f"line {line}: ")[1]
    assert "line 36" not in output
    assert "and 2 more" in output
    assert not (tmp_path / "lab").exists()
    path.write_text("[]")
    assert f"error: {path}, line 1: " in init(path, folder=tmp_path / "lab", code=1)


@pytest.mark.parametrize(
    ("name", "file_name", "message"),
    [
        ("Lab One", "scenes.jsonl", "lower-case words"),
        ("places-triway", "scenes.jsonl", "shipped configuration"),
        ("lab", "scenes.txt", "fits no known format"),
    ],
)
def test_invalid_arguments_are_refused(file, tmp_path, name, file_name, message) -> None:
    path = file.rename(tmp_path / file_name)
    assert message in init(path, folder=tmp_path / "o", name=name, code=1)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("scenes", "message", "code"),
    [
        (SCENES[:19], "19 scenes are too few: from fewer than 20", 1),
        ([replace(scene, group="one place") for scene in SCENES], "cannot be split", 1),
        ([], "contains no scene", 1),
        (SCENES[:40], "warning: 40 scenes of 22 groups are few", 0),
    ],
)
def test_too_few_scenes_are_refused_and_few_warned_of(tmp_path, scenes, message, code) -> None:
    write_jsonl(scenes, tmp_path / "scenes.jsonl")
    assert message in init(tmp_path / "scenes.jsonl", folder=tmp_path / "o", code=code)


@pytest.mark.parametrize(("copies", "states"), [(1, 8), (19, 32)])
def test_many_scenes_get_a_larger_machine(copies, states) -> None:
    rooms = [
        replace(room, scene_id=f"{room.scene_id} {k}", group=f"{room.group} {k}")
        for room in SCENES
        for k in range(copies)
    ]
    proposal = propose("lab", of_scenes(rooms), ["scenes.jsonl"])
    config, n = proposal.config, proposal.parts["train"]
    assert config.machine.variant == "triway"
    assert (config.machine.states, config.machine.coupled) == (states, False)
    assert 200 <= config.relations.epochs * math.ceil(n / config.relations.batch_size) <= 900
    assert 8 <= math.ceil(n / config.relations.batch_size) <= 25


def test_without_relations_and_positions_the_variant_is_rbm() -> None:
    bare = {"position": None, "size": None, "supported_by": None}
    rooms = [
        replace(room, objects=tuple(replace(thing, **bare) for thing in room.objects))
        for room in SCENES
    ]
    assert propose("lab", of_scenes(rooms), ["scenes.jsonl"]).config.machine.variant == "rbm"


def test_a_rare_label_is_no_class() -> None:
    scenes = [scene(f"s{k}", "workbench", "multimeter", "vice") for k in range(60)]
    scenes.append(scene("rare", "unicorn", "workbench"))
    proposal = propose("lab", of_scenes(scenes), ["scenes.jsonl"])
    assert (proposal.minimum, len(proposal.vocabulary)) == (8, 3)
    assert [label.name for label in proposal.dropped] == ["unicorn"]


def test_a_class_has_the_name_of_most_of_its_objects() -> None:
    """A synonym with more than half of the objects, in the spelling of the curated names."""

    def name(**counts: int) -> str:
        labels = [label.replace("_", " ") for label, n in counts.items() for _ in range(n)]
        labels += ["fork"] * 40
        scenes = [scene(str(k), x, "cup", "spoon", "plate") for k, x in enumerate(labels)]
        vocabulary = propose("lab", of_scenes(scenes), ["scenes.jsonl"]).vocabulary
        return vocabulary.labels[vocabulary.index(labels[0])]

    assert name(waste_bins=12, garbage_bin=9) == "waste bin"
    assert name(Garbage_bin=12, waste_bin=9) == "garbage bin"
    assert name(plastic_bottle=9, glass_bottle=8, bottle=7) == "bottle"


def test_kinds_have_the_most_frequent_name_of_their_class_as_parent() -> None:
    scenes = [scene(f"s{k}", "cutlery", "spoon", "plate") for k in range(40)]
    vocabulary = propose("lab", of_scenes(scenes), ["scenes.jsonl"]).vocabulary
    cutlery = vocabulary.labels.index("cutlery")
    assert vocabulary.index("utensil") == cutlery
    assert vocabulary.parents[vocabulary.index("spoon")] == cutlery
