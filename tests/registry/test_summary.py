"""The five sentences that start a model card: each figure is one of the description."""

from typing import Any

import pytest

from app.model import Calibration, CountSlope
from app.registry import VocabularyEntry
from app.registry.card import render_card
from app.registry.summary import summary
from app.scene.vocabulary import ObjectClass, Vocabulary
from tests.registry.small_artifacts import DATA, JUDGING, VOCABULARY, description
from training.evaluation.tasks import TASKS

NEUTRAL = Calibration.neutral(5)


def sentences(**changes: Any) -> list[str]:
    return summary(description(**changes))


def source(name: str, **changes: Any) -> dict[str, Any]:
    return DATA | {"source": name} | changes


def alarms(source: str, length: int, value: float, n: int, level: str = "medium") -> dict[str, Any]:
    name = f"alarms, {level}, {length} classes"
    assert name in TASKS["T3 alarms"].card, "publishing measures it"
    interval = {"value": value, "low": value, "high": value, "n": n}
    return {"task": "T3 alarms", "source": source, "metric": name} | interval


@pytest.mark.parametrize(
    ("data", "written", "sentence"),
    [
        ([source("rooms", scenes=300)], None, "300 scenes of 1 source (rooms), all seen."),
        (
            [source("ward.csv", scenes=1600, written=True)],
            160,
            "1,600 scenes of 1 source (ward.csv), all drawn from 10 written places.",
        ),
        (
            [source("a", scenes=60, written=True), *(source(x, scenes=10) for x in "bcdef")],
            None,
            "110 scenes of 6 sources, 60 drawn from written places, the others seen.",
        ),
    ],
)
def test_data_and_written_places(data, written, sentence) -> None:
    training = {} if written is None else {"config": {"data": {"written": written}}}
    assert sentences(data=data, training=training)[0] == f"The model learnt from {sentence}"


def test_knowledge_names_room_types_of_the_whole_list() -> None:
    assert sentences()[1] == (
        "The model knows 2 kinds of things and 2 types of rooms, such as bedroom and office."
    )
    rooms = [f"room {letter}" for letter in "abcdefghi"]
    words = VocabularyEntry.of(Vocabulary(VOCABULARY.objects, rooms))
    written = NEUTRAL.model_copy(update={"written_rooms": (3, 4)})
    spec = description().spec | {"C": 9}
    told = sentences(vocabulary=words, calibration=written, spec=spec)[1]
    assert "9 types of rooms, such as room a, room c, room e, room g and room i; 2 of these" in told
    bare = VocabularyEntry.of(Vocabulary(VOCABULARY.objects))
    told = sentences(vocabulary=bare, spec=description().spec | {"C": 0})[1]
    assert told.endswith("2 kinds of things and no type of room.")


def test_wrong_alarms_are_pooled_over_lists_of_several_things_at_the_default() -> None:
    assert sentences()[2] == "How often the model raises a wrong alarm is unknown."
    rows = [
        *(alarms("a", 1, 0.0, 1000), alarms("a", 2, 0.1, 100), alarms("a", 8, 0.02, 100)),
        *(alarms("b", 2, 0.3, 40), alarms("b", 2, 0.9, 40, "high")),
    ]
    assert sentences(metrics=rows)[2] == (
        "With the default sensitivity, the model raises a wrong alarm in 10.0 % of 240 lists of 2 "
        "to 8 things from unchanged test scenes; the highest share of a source is 30.0 % (b)."
    )
    assert sentences(metrics=rows[1:3])[2].endswith("6.0 % of 200 lists of 2 to 8 things from "
                                                    "unchanged test scenes.")  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({}, "The model judges no object and no relation: its calibration had too few scenes."),
        (
            {"outlier": CountSlope(), "outlier_lines": JUDGING["outlier_lines"]},
            "The model raises no alarm about words outside its vocabulary; it judges no relation.",
        ),
        (
            JUDGING | {"popularity": (0.0, None, 2.0, -7.0)},
            "The model raises no alarm about kinds that belong anywhere (1, such as dog), kinds "
            "that fewer than 1 of 500 training scenes show (1) and words outside its vocabulary.",
        ),
    ],
)
def test_things_without_a_judgement(changes, sentence) -> None:
    """Structure and things that belong anywhere do not count as rarely shown."""
    more = [ObjectClass("dog", anywhere=True)] if "popularity" in changes else []
    words = Vocabulary([*VOCABULARY.objects, *more], VOCABULARY.room_types)
    spec = description().spec | {"V": len(words)}
    calibration = NEUTRAL.model_copy(update=changes)
    vocabulary = VocabularyEntry.of(words)
    assert sentences(vocabulary=vocabulary, calibration=calibration, spec=spec)[3] == sentence


def test_a_home_names_its_parent_and_its_own_scenes() -> None:
    training = {"parent": {"name": "places", "version": "4.5.0", "digest": "0" * 64}}
    told = sentences(training=training)
    assert told[0] == "The model was adapted to one home from places@4.5.0."
    assert told[2] == "How often the model raises a wrong alarm in this home is unknown."
    figures = {"low": 0.0, "high": 0.2, "n": 37}
    rows = [
        {"task": "Home", "source": "home", "metric": f"scenes with an alarm, {side}", "value": v}
        | figures
        for side, v in (("parent", 0.108), ("adapted", 0.0))
    ]
    told = sentences(training=training | {"recorded": 50, "written": 1}, metrics=rows)
    assert told[0].endswith(" from places@4.5.0 with 50 recorded scenes and 1 written place of this"
                            " home.")  # fmt: skip
    assert told[2] == (
        "With the default sensitivity, the model raises an alarm, right or wrong, in 0.0 % of 37 "
        "recorded scenes that the fit did not see, and its parent in 10.8 %."
    )


def test_the_sentences_precede_the_tables_of_the_card() -> None:
    one = description(data=[source("a|b # Heading", research_only=True)])
    lines = render_card(one, {}).split("## Model")[0].splitlines()
    assert lines[0] == "# tiny 1.0.0"
    listed = [line.removeprefix("- ") for line in lines if line.startswith("- ")]
    assert listed[1:4] == summary(one)[1:4]
    assert len(listed) == 5
    assert "a\\|b # Heading" in listed[4]
