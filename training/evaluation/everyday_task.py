"""Everyday facts: questions with answers that people agree on, for acceptance tests only.

People wrote the facts by hand before any model was evaluated. Training and tuning must never use
the facts, so only this module of the package reads the facts file. The requests use the default
parameters of the service. Labels outside the vocabulary are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from app import questions
from app.errors import RequestError
from app.model import SceneModel
from app.questions.names import ErrorList
from app.questions.reading import Limits, Reading, read_scene
from app.scene import Scene, opposite
from scene_client.schemas import SceneRequest
from training.datasets.files import DATA
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.setting import Outcome, Setting

EVERYDAY = DATA.parent / "everyday"
"""Default folder of the facts, outside the repository: facts.json, which people wrote by hand.
Without this file, the task is skipped."""

SOURCE = "facts"

LINES = (
    "relations: the fact is the likeliest of eight",
    "relations: the fact is the likeliest vertical one",
    "relations: the fact has p of at least .5",
    "missing: an expected object is among five",
    "missing_at: an expected object is among five",
    "outliers: the intruder comes first",
    "outliers: the intruder is flagged at the default",
    "outliers: plain scenes with an alarm at the default",
    "generate: the scene has what makes the room",
    "generate: the scene has what never belongs",
    "generate: scenes of fewer than three classes",
)
"""Counts of the report. Lower is better for alarms in plain scenes, and for the last two."""

_VERTICAL = {"on-top", "under", "above", "below"}
_NEWER = ("inside", "contains")
_RELATIONS = 50
_LISTED = 5
_DRAWN = 8
_FEW = 3

Lines = dict[str, list[tuple[int, int]]]  # (hits, questions) of each fact, by name in `LINES`


def facts_file(folder: Path = EVERYDAY) -> Path | None:
    """Return the path of the facts file in a folder, or None if the file does not exist."""
    path = folder / "facts.json"
    return path if path.is_file() else None


def everyday_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the everyday facts. Each fact counts as one scene. `setting.scenes` is not used."""
    folder = setting.everyday
    if folder is None or facts_file(folder) is None:
        return None
    lines = {line: np.array(pairs, float) for line, pairs in ask_everyday(artifact, folder).items()}
    metrics: dict[str, Metric] = {
        line: Ratio(*pairs.T) for line, pairs in lines.items() if pairs.any()
    }
    return Outcome(metrics, sum(map(len, lines.values())), 0)


def ask_everyday(artifact: SceneModel, folder: Path = EVERYDAY) -> Lines:
    """Ask about every fact in the folder.

    Raises:
        FileNotFoundError: the folder contains no facts.
    """
    facts: dict[str, Any] = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    lines: Lines = {name: [] for name in LINES}

    def add(names: Sequence[str], *hits: int, questions: int = 1) -> None:
        for name, count in zip(names, hits, strict=True):
            lines[name].append((int(count), questions))

    for fact in facts["relations"]:
        add(LINES[:3], *_relation_hits(artifact, fact))
    for name, line in (("missing", LINES[3]), ("missing_at", LINES[4])):
        for fact in facts[name]:
            add([line], not set(_first_missing(artifact, fact)).isdisjoint(fact["expected"]))
    for fact in facts["intruders"]:
        ranked, flagged = _outliers(artifact, [*fact["objects"], fact["intruder"]])
        add(LINES[5:7], ranked[:1] == [fact["intruder"]], fact["intruder"] in flagged)
    for fact in facts["plain"]:
        add(LINES[7:8], bool(_outliers(artifact, fact["objects"])[1]))
    for room, seed in product(facts["rooms"], facts["seeds"]):
        empty = Scene((), room_type=artifact.vocabulary.room_index(room["room"]))
        answer = questions.generate(artifact, empty, count=_DRAWN, seed=seed)
        scenes = [set(scene["objects"]) for scene in answer["scenes"]]
        typical = sum(bool(labels & set(room["one_of"])) for labels in scenes)
        foreign = sum(bool(labels & set(room["never"])) for labels in scenes)
        small = sum(len(labels) < _FEW for labels in scenes)
        add(LINES[8:], typical, foreign, small, questions=len(scenes))
    return lines


def _read(artifact: SceneModel, labels: Sequence[str]) -> Reading | None:
    """Read the labels as a request does. Return None if the model knows none of them."""
    request = SceneRequest(objects=list(labels), unknown_labels="ignore")
    try:
        return read_scene(request, artifact.vocabulary, Limits())
    except RequestError:
        return None


def _relation_hits(artifact: SceneModel, fact: Mapping[str, str]) -> tuple[bool, bool, bool]:
    """Return whether the relation is the likeliest, the likeliest vertical one, and has p >= .5.

    The facts were written before the relations inside and contains existed, so these are left out.
    """
    subject, relation = fact["subject"], fact["relation"]
    p: dict[str, float] = {}
    if (reading := _read(artifact, [subject, fact["object"]])) is not None:
        answer = questions.relations(
            artifact, reading.scene, top_k=_RELATIONS, include_opposites=True
        )
        for entry in answer["relations"]:
            name = entry["relation"]
            if name not in _NEWER:
                name = name if entry["subject"] == subject else opposite(name)
                p[name] = max(p.get(name, 0.0), entry["probability"])
    likeliest = max(p, key=p.__getitem__, default="")
    vertical = max(_VERTICAL & p.keys(), key=p.__getitem__, default="")
    return likeliest == relation, vertical == relation, p.get(relation, 0.0) >= 0.5


def _first_missing(artifact: SceneModel, fact: Mapping[str, Any]) -> list[str]:
    """Return the first five labels, or an empty list if the service would reject the request."""
    reading, at = _read(artifact, fact["objects"]), None
    if reading is None:
        return []
    if "at" in fact:
        anchor = reading.names.find(fact["at"]["object"], ("at", "object"), ErrorList())
        if anchor is None:
            return []
        at = fact["at"]["relation"], anchor
    answer = questions.missing(artifact, reading.scene, top_k=_LISTED, at=at)
    return [entry["label"] for entry in answer["missing"]]


def _outliers(artifact: SceneModel, labels: Sequence[str]) -> tuple[list[str], set[str]]:
    """Return the labels, the most suspicious first, and the labels of reported outliers."""
    reading = _read(artifact, labels)
    entries = [] if reading is None else questions.outliers(artifact, reading.scene)["outliers"]
    flagged = {entry["label"] for entry in entries if entry["is_outlier"]}
    return [entry["label"] for entry in entries], flagged
