from dataclasses import replace

from scene_client.frames import Conventions
from tests.training.evaluation.scenes import scene as encoded_scene
from tests.training.scenes import scene
from training.datasets import generate_rooms
from training.datasets.rooms import DOMAINS
from training.domain import look as module
from training.domain.look import Facts, count_labels, outside_vocabulary, similar_labels


def look(scenes) -> Facts:
    return module.look(scenes, count_labels(scenes))


def finding(words: str, *scenes) -> tuple[int, list[str]]:
    """Number and examples of the finding whose sentence contains some words."""
    findings = look(scenes).findings
    return next(((f.count, f.examples) for f in findings if words in f.what), (0, []))


CUP_ON_TABLE = (0, "on-top", 1)


def test_facts_are_counted() -> None:
    facts = look(
        [
            scene("a", "cup", "table", relations=[CUP_ON_TABLE], room="Kitchen"),
            scene("b", "cup", "table", "lamp", group="a", position=[(0.0, 0.0, 1.0)] * 3),
        ]
    )
    assert (facts.scenes, facts.groups) == (2, 1)
    assert facts.objects_per_scene == (2, 2.5, 3)
    assert facts.rooms == {"kitchen": 1}
    assert facts.annotated["relations"] == facts.annotated["positions"] == 0.5
    assert facts.related
    assert not look([scene("a", "cup", "table"), scene("b", "lamp", "bed")]).related


def test_relations_in_both_directions_are_found_in_either_wording() -> None:
    count, examples = finding(
        "both directions", scene("a", "cup", "pot", relations=[(0, "left", 1), (0, "right", 1)])
    )
    assert count == 1
    assert "cup (0) and pot (1)" in examples[0]
    agreed = scene("a", "cup", "pot", relations=[(0, "left", 1), (1, "right", 0)])
    assert finding("both directions", agreed) == (0, [])


def test_an_object_on_top_of_an_object_above_it_is_found() -> None:
    scenes = scene("a", "cup", "table", relations=[CUP_ON_TABLE, (1, "above", 0)])
    assert finding("on-top of", scenes)[0] == 1


def test_copies_in_other_groups_are_found() -> None:
    related = {"relations": [CUP_ON_TABLE]}
    first, second = (scene(name, "cup", "table", **related) for name in "ab")
    assert finding("different groups", first, second) == (1, ["a and b"])
    framed = scene("c", "cup", "table", group="a", **related)
    assert finding("different groups", first, framed) == (0, [])
    stacked = [scene(name, "cup", "bed", supported_by=["1", None]) for name in "ab"]
    assert finding("different groups", *stacked) == (1, ["a and b"])
    # Two small rooms may contain the same objects.
    assert finding("different groups", scene("a", "cup", "bed"), scene("b", "cup", "bed"))[0] == 0


def test_examples_are_few_and_all_are_counted() -> None:
    count, examples = finding("fewer than two", *(scene(str(k), "cup") for k in range(40)))
    assert count == 40
    assert len(examples) == 5


def test_millimetres_are_found() -> None:
    far = scene("far", "cup", "table", position=[(2100.0, 0.0, 400.0), (1.0, 0.0, 0.4)])
    big = scene("big", "cup", "table", size=[(80.0, 80.0, 100.0), None])
    near = scene("near", "cup", "table", position=[(2.1, 0.0, 0.4)] * 2, size=[(1.0, 1.0, 1.0)] * 2)
    for axes in (True, False):
        every = [replace(one, viewer_frame=axes) for one in (far, big, near)]
        assert finding("Positions are beyond", *every) == (2, ["far", "big"])


ROOM = ("bed", "desk", "chair", "wardrobe")
SIZES = [(2.0, 1.6, 0.6), (1.4, 0.7, 0.75), (0.5, 0.5, 0.9), (1.2, 0.6, 2.0)]
PLACES = [(2.0, 1.0, 0.3), (0.0, -1.0, 0.375), (0.0, 0.0, 0.45), (-2.0, 1.0, 1.0)]


def test_another_convention_is_found_if_several_scenes_show_it() -> None:
    """Half extents, in scenes whose declared convention is that of the file."""
    half = [tuple(side / 2 for side in size) for size in SIZES]
    right, wrong = (
        [scene(f"{name}{k}", *ROOM, position=PLACES, size=sizes) for k in range(10)]
        for name, sizes in (("right", SIZES), ("wrong", half))
    )
    words = "another convention"
    assert finding(words, *wrong) == (10, [f"wrong{k}" for k in range(5)])
    assert finding(words, *right) == (0, [])
    assert finding(words, *right, wrong[0]) == (0, [])
    (advice,) = {one.advice for one in look(wrong).findings if words in one.what}
    assert "declare `extents` as half" in advice
    # The sizes of a file with whole sides that declares half of each side are doubled.
    double = [tuple(side * 2 for side in size) for size in SIZES]
    declared = replace(
        scene("declared", *ROOM, position=PLACES, size=double),
        conventions=Conventions(extents="half"),
    )
    (advice,) = {one.advice for one in look([declared]).findings if words in one.what}
    assert "declare `extents` as full" in advice


def test_generated_scenes_contradict_nothing() -> None:
    facts = look(generate_rooms(60, 0, DOMAINS["workplaces"]))
    assert [x.examples for x in facts.findings] == [["pallet jack (3) and pallet rack (31)"]]
    assert facts.annotated["viewer axes"] == 1.0


def test_spellings_and_aliases_count_as_one_label() -> None:
    scenes = [scene("a", "Lab Stool", "lab_stools", "couch"), scene("b", "lab stool", "sofa")]
    found = {label.name: label for label in count_labels(scenes)}
    assert set(found) == {"lab stool", "sofa"}
    stool = found["lab stool"]
    assert stool.mentions == 3
    assert set(stool.spellings) == {"Lab Stool", "lab_stools", "lab stool"}
    assert found["sofa"].mentions == 2


def test_likely_typing_errors_are_found() -> None:
    counts = {"oscilloscope": 30, "osciloscope": 2}
    # Names that are short, curated or numbered are different objects.
    counts |= {"blad": 9, "blat": 1, "table": 9, "tables top": 3, "conveyor 1": 8, "conveyor 2": 1}
    scenes = [scene(f"{label} {k}", label) for label, n in counts.items() for k in range(n)]
    (pair,) = similar_labels(count_labels(scenes))
    found = [(label.name, label.mentions) for label in pair]
    assert found == [("osciloscope", 2), ("oscilloscope", 30)]


def test_labels_outside_the_vocabulary_are_one_line() -> None:
    unknown = [("balcony", "sofa bed"), ("Sofa_beds",), ("sofa bed",), ()]
    scenes = [encoded_scene([0], unknown=labels) for labels in unknown]
    line = outside_vocabulary(scenes)
    assert "2 labels in 3 scenes" in line
    assert '"sofa bed" (3 scenes), "balcony" (1 scene)' in line
    assert outside_vocabulary(scenes[3:]) == ""
    many = [encoded_scene([0], unknown=tuple(f"label {k}" for k in range(99)))]
    assert "91 more; they are left out" in outside_vocabulary(many)
