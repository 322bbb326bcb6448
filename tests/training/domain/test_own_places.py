import json
from pathlib import Path

import numpy as np
import pytest

from app import questions
from app.model.possibility import IN, ON
from app.registry import Store
from app.scene import Scene, label_key
from app.scene.stands import FLOOR, SUPPORTED
from tests.training.commands import init, invoke, prepared
from tests.training.scenes import request, scene
from training.datasets import generate_rooms
from training.datasets.inventories import THING_COLUMNS, read_inventory
from training.datasets.jsonl import write_jsonl
from training.datasets.rooms import DOMAINS
from training.fit.count_statistics import fit_counts
from training.fit.draft import placed_draft
from training.fit.objects import ObjectScenes
from training.machines import MachineSpec, build
from training.runs.config_files import load_config
from training.runs.pipeline import SplitScenes
from training.runs.publish import data_sources

HEAD = "room_type,label,relation,anchor"


@pytest.fixture
def ward(repository) -> Path:
    return repository / "examples" / "ward.csv"


def test_an_inventory_alone_makes_a_proposal(ward, tmp_path) -> None:
    folder = tmp_path / "ward"
    output = init(ward, folder=folder, options=("--terms", "ours"))
    each = load_config(str(folder)).data.written
    assert f"6 written places, of which training draws {each} scenes each; 0 seen" in output
    assert "warning" not in output
    assert "no contradictions found" in output
    assert f"python -m training train {folder} --publish 1.0.0 --store my-store" in output
    scenes = prepared(folder)
    assert scenes.counts == {"ward.csv": 6 * each}
    # Every place is in every part, and every written thing is a class.
    for part in scenes.parts.values():
        assert len({one.group for one in part}) == 6
        assert all(one.room_type >= 0 for one in part)
        assert not any(one.unknown for one in part)
    # A thing is in as many scenes as its share says, whatever its size.
    patient_rooms = [x for x in scenes.parts["train"] if x.group == "patient room"]
    for label, share in (("hospital bed", 1.0), ("call button", 0.9)):
        index = scenes.vocabulary.index(label)
        found = np.mean([index in one.evidence.classes for one in patient_rooms])
        assert found == pytest.approx(share, abs=0.1 if share < 1 else 0)
    written = {item.label for place in read_inventory(ward).places for _, item in place.items}
    assert all(scenes.vocabulary.index(label) is not None for label in written)
    assert np.isfinite(scenes.vocabulary.sizes[scenes.vocabulary.index("hospital bed")]).all()
    assert fit_counts(scenes.parts["train"], scenes.vocabulary) is None, "numbers are judgements"
    (source,) = data_sources(scenes, learnt(scenes))
    assert (source.source, source.written, source.share, source.terms) == (
        *("ward.csv", True, 1.0, "ours"),
    )


def learnt(scenes: SplitScenes) -> ObjectScenes:
    data, config = scenes.training_data(), load_config("places-triway").objects
    own = config.model_copy(update={"source_weights": {}, "open_sources": ()})
    return ObjectScenes.of(data.train, data.structure, own)


def test_an_inventory_joins_scenes(ward, tmp_path) -> None:
    """The card says which share was written. Ten seen scenes are enough beside an inventory."""
    rooms = [scene(f"s{k}", "hospital bed", "robot", f"object_{k}", room="ward") for k in range(10)]
    write_jsonl(rooms, tmp_path / "seen.jsonl")
    output = init(tmp_path / "seen.jsonl", ward, folder=tmp_path / "ward")
    assert "10 seen scenes" in output
    assert "left out, because they name no kind of object: object_0 (1), object_1 (1)" in output
    scenes = prepared(tmp_path / "ward")
    each = load_config(str(tmp_path / "ward")).data.written
    assert scenes.counts == {"seen": 10, "ward.csv": 6 * each}
    assert "robot" in scenes.vocabulary.labels
    assert not any(label.startswith("object") for label in scenes.vocabulary.labels)
    shares = {source.source: source for source in data_sources(scenes, learnt(scenes))}
    assert (shares["seen"].written, shares["ward.csv"].written) == (False, True)
    assert shares["seen"].share + shares["ward.csv"].share == pytest.approx(1, abs=1e-3)


def test_as_many_written_scenes_are_drawn_as_seen_ones(tmp_path) -> None:
    write_jsonl(generate_rooms(900, 0, DOMAINS["workplaces"]), tmp_path / "seen.jsonl")
    rows = ["hall,coat,,", "hall,shoe,,", "hall,bag,,", "shed,rake,,"]
    (tmp_path / "two.csv").write_text("\n".join([HEAD, *rows]))
    init(tmp_path / "seen.jsonl", tmp_path / "two.csv", folder=tmp_path / "ward")
    assert load_config(str(tmp_path / "ward")).data.written == 450


def test_each_written_thing_has_its_own_name(tmp_path) -> None:
    """Synonyms become names, and init prints labels and room types that answers call otherwise."""
    labels = ["cup", "coffee cup", "visitor chair", "office chair", "medicine cabinet", "TV"]
    labels += ["television", "walking frame"]
    rows = [f"patient room,{label},," for label in labels]
    (tmp_path / "places.csv").write_text("\n".join([HEAD, *rows]))
    output = init(tmp_path / "places.csv", folder=tmp_path / "ward")
    assert "broader class: coffee cup is a cup room types" in output
    assert "in answers: patient room = hospital room no contradictions" in output
    words = prepared(tmp_path / "ward").vocabulary
    own = [words.index(label) for label in labels]
    assert [label_key(words.labels[k]) for k in own] == list(map(label_key, labels))
    parents = {entry.label: entry.parent for entry in words.objects if entry.parent}
    assert parents == {"coffee cup": "cup"}
    names = {label: words.index(label) for label in ("chair", "cabinet", "walker", "mug")}
    assert names == dict(zip(names, (own[2], own[4], own[7], own[0]), strict=True))
    for other in ("filing cabinet", "sideboard", "armchair", "cane"):
        assert words.index(other) is None


def test_own_places_have_a_prior_of_possibility(tmp_path) -> None:
    """Ten places show few pairs. The things of the own table count like those of the repository."""
    rows = ["hall,table,floor,", "hall,cup,on-top,table", "hall,vat,floor,", "hall,gizmo,,"]
    (tmp_path / "places.csv").write_text("\n".join([HEAD, *rows]))
    vat = ["vat", 1.2, 1.2, 0.9, 1.3, "floor 1", "no", "yes", "no", "", ""]
    table = [THING_COLUMNS, vat]
    (tmp_path / "things.csv").write_text("\n".join(",".join(map(str, row)) for row in table))
    init(tmp_path / "places.csv", folder=tmp_path / "hall")
    data = prepared(tmp_path / "hall").training_data()
    words, prior = data.vocabulary, data.possibility
    assert prior is not None
    index = [words.index(label) for label in ("cup", "table", "vat", "gizmo")]
    assert prior.is_described[index].tolist() == [True, True, True, False]
    rows = prior.rows(np.array(index), words.sizes[index])
    c = prior.log_p(rows, rows)
    assert c[ON, 0, 1] > c[ON, 1, 0] + 3  # the cup on the table, and the table on the cup
    assert c[IN, 0, 2] > c[IN, 0, 1]  # the vat contains things, and the table sometimes does
    assert c[ON, 0, 1] > c[ON, 2, 1] + 3
    places = placed_draft(build(MachineSpec("rbm", V=len(words), A=5, units=1)), data).places
    assert places is not None
    # No own scene shows a cup on the floor, nor that the vat hangs.
    assert places.stands[index[0], SUPPORTED] > 0.8
    assert places.stands[index[2], FLOOR] > 0.8


def test_errors_are_listed_and_nothing_is_written(tmp_path) -> None:
    path = tmp_path / "places.csv"
    path.write_text(f"{HEAD}\nhall,,,\nhall,cup,on-top,table\n")
    output = init(path, folder=tmp_path / "ward", code=1)
    assert "places.csv has 2 errors; nothing was written" in output
    assert "places.csv, line 2, column label: is empty" in output
    assert "places.csv, line 3, column anchor: the place 'hall' has no row" in output
    assert not (tmp_path / "ward").exists()
    path.write_text("room_type,label\nhall,object_7\n")
    assert "has no rows" in init(path, folder=tmp_path / "ward", code=1)
    path.write_text(f"{HEAD}\nhall,cup,,\n")
    (tmp_path / "again").mkdir()
    (again := tmp_path / "again" / "places.csv").write_text(path.read_text())
    assert "two sources are called places.csv" in init(path, again, folder=tmp_path / "w", code=1)


def test_an_update_adds_an_inventory_to_scenes(tmp_path) -> None:
    write_jsonl(generate_rooms(80, 0, DOMAINS["workplaces"]), tmp_path / "seen.jsonl")
    init(tmp_path / "seen.jsonl", folder=tmp_path / "ward")
    before = load_config(str(tmp_path / "ward"))
    (tmp_path / "new.csv").write_text("room_type,label\nattic,trunk\nattic,rocking horse\n")
    output = init(tmp_path / "new.csv", folder=tmp_path / "ward", options=["--update"])
    assert "new room types: attic new sources: ../new.csv" in output
    config = load_config(str(tmp_path / "ward"))
    assert config.data.sources == ("../seen.jsonl", "../new.csv")
    assert config.objects == before.objects
    scenes = prepared(tmp_path / "ward")
    assert scenes.counts == {"seen": 80, "new.csv": config.data.written}
    assert {"trunk", "rocking horse"} <= set(scenes.vocabulary.labels)
    values = json.loads((tmp_path / "ward" / "vocabulary.json").read_text())
    assert "attic" in values["room_types"]
    again = init(tmp_path / "new.csv", folder=tmp_path / "ward", options=["--update"])
    assert "no new classes" in again


@pytest.mark.slow
def test_from_the_table_to_answers(ward, tmp_path) -> None:
    folder, store = tmp_path / "ward", Store(tmp_path / "store")
    init(ward, folder=folder)
    runs = ("--runs", tmp_path / "runs", "--store", store.root)
    assert "published ward@1.0.0" in invoke("train", folder, "--publish", "1.0.0", *runs)
    artifact = store.load("ward", "1.0.0")
    model = artifact.model
    assert model.possibility is not None
    assert (model.possibility.weights >= 0).all()
    assert "Scenes drawn from written places have 100.0 %" in " ".join(artifact.card.split())
    assert model.calibration.outlier_lines is not None
    words = model.vocabulary
    places = read_inventory(ward).places
    things = {place.name: {x.label for _, x in place.items} for place in places}
    asked = {
        "patient room": ["hospital bed", "pillow", "IV stand", "bedside cabinet", "visitor chair"],
        "nurse station": ["desk", "computer", "telephone", "folder", "whiteboard"],
        "patient bathroom": ["toilet", "mirror", "towel", "soap dispenser", "grab bar"],
    }
    for place, labels in asked.items():
        answer = questions.missing(model, request(model, *labels), top_k=5)
        own = {words.labels[index] for x in things[place] if (index := words.index(x)) is not None}
        assert {entry["label"] for entry in answer["missing"]} <= own
    intruded = questions.outliers(model, request(model, *asked["patient room"], "toilet"))
    assert [x["object"] for x in intruded["outliers"] if x["is_outlier"]] == ["toilet"]
    rooms = questions.rooms(model, request(model, "toilet", "mirror"))["room_types"]
    assert rooms[0]["room_type"] == "bathroom"
    # All patient rooms have a bed.
    others = ["pillow", "blanket", "bedside cabinet", "overbed table", "call button", "wardrobe"]
    for count in (3, len(others)):
        scene = request(model, *others[:count])
        for coverage in (None, 0.5):
            answer = questions.missing(model, scene, top_k=len(words), coverage=coverage)
            p = {entry["label"]: entry["probability"] for entry in answer["missing"]}
            assert p["hospital bed"] > 0.8, (count, coverage)
    room = words.room_index("patient room")
    generated = questions.generate(model, Scene((), room_type=room), seed=1, count=20)["scenes"]
    assert sum("hospital bed" in one["objects"] for one in generated) >= 17
