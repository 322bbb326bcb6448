"""Families of classes: a listed office chair is a chair, and a chair may be an office chair."""

from dataclasses import replace

import pytest

from app.questions.missing import missing
from app.scene import ObjectClass, Scene, SceneObject, Vocabulary
from tests.questions.artifacts import LARGER, artifact_of, random_machine

# shelf < desk < lamp and chair < lamp; vase < sofa.
PARENTS = {"desk": "lamp", "shelf": "desk", "chair": "lamp", "vase": "sofa"}
BASE = artifact_of(random_machine(LARGER["triway-states"], 1.0))
VOCABULARY = Vocabulary(
    [
        ObjectClass(entry.label, structure=entry.structure, parent=PARENTS.get(entry.label))
        for entry in BASE.vocabulary.objects
    ],
    BASE.vocabulary.room_types,
)
FAMILIES = replace(BASE, vocabulary=VOCABULARY)


def ask(*labels, artifact=FAMILIES, **options):
    """The labels and probabilities of /missing for a scene with these labels."""
    index = VOCABULARY.labels.index
    if names := options.pop("candidates", None):
        options["candidates"] = [index(name) for name in names]
    things = tuple(SceneObject(label, label, index(label)) for label in labels)
    answer = missing(artifact, Scene(things), details=False, **options)
    return {entry["label"]: entry["probability"] for entry in answer["missing"]}


@pytest.mark.parametrize(
    ("listed", "left_out"),
    [
        ("desk", {"desk", "lamp", "shelf"}),
        ("shelf", {"shelf", "desk", "lamp"}),
        ("lamp", {"lamp", "desk", "shelf", "chair"}),
        ("chair", {"chair", "lamp"}),
        ("bed", {"bed"}),
    ],
)
def test_no_class_of_a_listed_family_is_proposed(listed, left_out):
    every = ask(listed, artifact=BASE)
    proposed = ask(listed)
    assert not left_out & proposed.keys()
    # Of the others, the classes that have a likelier relative are left out.
    related = VOCABULARY.related
    index = VOCABULARY.labels.index
    for label, probability in every.items():
        if label in left_out:
            continue
        likelier = [
            x for x in proposed if every[x] > probability and related[index(x), index(label)]
        ]
        assert (label in proposed) != bool(likelier)
        assert probability == proposed.get(label, probability)


def test_the_list_is_full_although_relatives_are_left_out():
    assert list(ask("bed", top_k=2)) == list(ask("bed"))[:2]
    assert len(ask("bed", top_k=2)) == 2
    first, second = list(ask("bed"))[:2]
    assert not VOCABULARY.related[VOCABULARY.labels.index(first), VOCABULARY.labels.index(second)]


def test_named_kinds_of_a_listed_class_are_candidates_and_its_broader_classes_are_listed():
    proposed = ask("desk", candidates=["lamp", "shelf", "sofa", "vase"])
    assert proposed.keys() == {"shelf", "sofa", "vase"}
    assert not ask("shelf", candidates=["lamp", "desk"])
    assert ask("lamp", candidates=["desk", "shelf"]).keys() == {"desk", "shelf"}


@pytest.mark.parametrize("at", [None, ("on-top", 0)])
def test_places_follow_the_same_rule(at):
    answers = ask("desk", "bed", at=at)
    assert not {"lamp", "shelf", "desk", "bed"} & answers.keys()
    assert len({"sofa", "vase"} & answers.keys()) == 1
