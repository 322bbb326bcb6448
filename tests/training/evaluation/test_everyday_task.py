import json
import re
import runpy
import sys
from itertools import permutations
from pathlib import Path

import pytest

from app.registry import Store, load_model_set
from app.scene import Scene, SceneObject, opposite
from tests.conftest import REPOSITORY
from tests.questions.answers import relations
from tests.training.evaluation.furnished_rooms import STRUCTURE, room_model, rooms
from training.evaluation import everyday_task as everyday
from training.evaluation.everyday_task import EVERYDAY, LINES, everyday_task, facts_file
from training.evaluation.report import digest, evaluate
from training.evaluation.setting import Setting

FOLDER = REPOSITORY / EVERYDAY
STORE = REPOSITORY / "model_store"
ROOM = "bedroom"
FACTS = {
    "relations": [
        {"subject": "lamp", "relation": "on-top", "object": "nightstand"},
        {"subject": "lamp", "relation": "under", "object": "zeppelin"},
        {"subject": "zeppelin", "relation": "under", "object": "airship"},
    ],
    "missing": [
        {"objects": ["bed", "zeppelin"], "expected": ["pillow", "lamp"]},
        {"objects": ["zeppelin"], "expected": ["pillow"]},
    ],
    "missing_at": [
        {"objects": objects, "at": {"relation": "on-top", "object": anchor}, "expected": expected}
        for objects, anchor, expected in (
            (["bed", "nightstand"], "nightstand", ["lamp", "book"]),
            (["bed"], "desk", ["lamp"]),
            (["bed", "nightstand"], "night stand", ["lamp", "book"]),
        )
    ],
    "plain": [{"room": ROOM, "objects": ["bed", "pillow", "lamp"]}],
    "intruders": [
        {"room": ROOM, "objects": ["bed", "pillow", "lamp", "lamp"], "intruder": "toilet"}
    ],
    "rooms": [{"room": ROOM, "one_of": ["bed"], "never": ["toilet"]}],
    "seeds": [5, 6],
}


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "facts.json").write_text(json.dumps(FACTS))
    return tmp_path


def score(monkeypatch, capsys, *arguments: str) -> dict[str, tuple[int, int]]:
    """What the script that came with the facts prints."""
    monkeypatch.setattr(sys, "argv", ["score.py", *arguments])
    runpy.run_path(str(FOLDER / "score.py"), run_name="__main__")
    lines: dict[str, str] = json.loads(capsys.readouterr().out)
    return {name: tuple(map(int, value.split("/"))) for name, value in lines.items()}


def ask_everyday(artifact, folder: Path) -> dict[str, tuple[int, int]]:
    found = everyday.ask_everyday(artifact, folder)
    return {line: tuple(map(sum, zip(*each, strict=True))) for line, each in found.items()}


needs_facts = pytest.mark.skipif(facts_file(FOLDER) is None, reason="the facts are not here")


@needs_facts
@pytest.mark.slow
@pytest.mark.parametrize(("model", "made"), [("places-triway", False), ("places-rbm", True)])
def test_the_service_gives_the_same_eleven_lines(shipped, model, made, folder, monkeypatch, capsys):
    place = folder if made else FOLDER
    artifact = load_model_set(Store(STORE)).resolve(model).model
    expected = score(monkeypatch, capsys, shipped.url, str(place / "facts.json"), "--model", model)
    found = ask_everyday(artifact, place)
    assert found == expected
    assert tuple(found) == LINES


def test_the_task_has_a_metric_for_each_line_and_unknown_labels_count_as_missed(folder):
    found = ask_everyday(room_model(), folder)
    assert [found[line][1] for line in LINES] == [3, 3, 3, 2, 3, 1, 1, 1, 16, 16, 16]
    assert found["missing: an expected object is among five"][0] <= 1
    outcome = everyday_task(room_model(), Setting(rooms(5, 1), STRUCTURE, everyday=folder))
    assert tuple(outcome.metrics) == LINES
    for line, (hits, asked) in found.items():
        assert outcome.metrics[line].value == pytest.approx(hits / asked)
        assert outcome.metrics[line].n == asked
    rows = evaluate(room_model(), rooms(8, 1), STRUCTURE, rooms(9, 2), limit=2, everyday=folder)
    card = [(row.source, row.metric) for row in rows if row.task == "Everyday"]
    # A single fact has no interval.
    assert card == [("facts", x) for x in LINES if len(outcome.metrics[x].groups) > 1]


def test_a_fact_and_its_mirror_image_are_the_same_fact(tmp_path):
    """The likeliest relation of two objects is so too from the other object, as its opposite."""
    model = room_model()
    # Two objects whose likeliest relation of ten is inside, which is not one of the eight.
    for names in permutations(model.vocabulary.labels, 2):
        things = (SceneObject(name, name, model.vocabulary.index(name)) for name in names)
        found = relations(model, Scene(tuple(things)), top_k=50)
        if max(found, key=lambda answer: answer.probability).relation == "inside":
            break
    eight = [answer for answer in found if answer.relation != "inside"]
    assert len(eight) < len(found)
    first = max(eight, key=lambda answer: answer.probability)
    subject, object_ = names[first.subject], names[first.object]
    mirrored = opposite(first.relation)
    facts = [
        {"subject": subject, "relation": first.relation, "object": object_},
        {"subject": object_, "relation": mirrored, "object": subject},
        {"subject": subject, "relation": mirrored, "object": object_},
    ]
    (tmp_path / "facts.json").write_text(json.dumps(FACTS | {"relations": facts}))
    assert ask_everyday(model, tmp_path)["relations: the fact is the likeliest of eight"] == (2, 3)


def test_absent_facts_leave_the_task_out_and_other_facts_are_other_questions(folder, tmp_path):
    for place in (None, tmp_path / "nowhere"):
        assert everyday_task(room_model(), Setting(rooms(5, 1), STRUCTURE, everyday=place)) is None
    setting = Setting(rooms(5, 1), STRUCTURE, everyday=folder)
    before = digest(setting)
    (folder / "facts.json").write_text(json.dumps(FACTS | {"seeds": [7]}))
    assert digest(setting) != before


def test_no_training_or_tuning_asks_the_facts():
    """No module names the file, and what reads scenes or fits weights never names the task."""
    named = re.compile(r"facts\.json|shared/everyday|/\s*[\"']everyday\b|[\"']\S*/everyday\b")
    own = REPOSITORY / "training/evaluation/everyday_task.py"
    sources = [*(REPOSITORY / "training").rglob("*"), *(REPOSITORY / "app").rglob("*.py")]
    for path in sources:
        if path.suffix in (".py", ".toml", ".json") and path != own:
            text = path.read_text(encoding="utf-8")
            assert not named.search(text), f"{path} names the everyday facts"
    for folder in ("datasets", "fit", "machines"):
        for path in (REPOSITORY / "training" / folder).rglob("*.py"):
            assert "everyday" not in path.read_text(encoding="utf-8"), path
