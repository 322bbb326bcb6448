"""Everyday facts: questions with answers that people agree on, for acceptance tests only.

People wrote the facts by hand before any model was evaluated. Training and tuning must never use
the facts, so only this module of the package reads the facts file. The requests use the default
parameters of the service. Labels outside the vocabulary are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from app import questions
from app.questions.answer import Fields
from app.registry import Artifact
from app.scene import Scene, SceneObject, opposite
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
"""Names of the eleven counts of the report.

Lower is better for the alarms in plain scenes (without intruder) and for the last two names.
"""

_VERTICAL = {"on-top", "under", "above", "below"}
_NEWER = ("inside", "contains")
_RELATIONS = 50
_LISTED = 5
_DRAWN = 8
_FEW = 3

# Maps each name in `LINES` to a list of (number of hits, number of questions), one pair per fact.
Lines = dict[str, list[tuple[int, int]]]


def facts_file(folder: Path = EVERYDAY) -> Path | None:
    """Return the path of the facts file in a folder, or None if the file does not exist."""
    path = folder / "facts.json"
    return path if path.is_file() else None


def facts_digest(folder: Path) -> str:
    """Return the SHA-256 of the facts file, or an empty string if the file does not exist."""
    path = facts_file(folder)
    return "" if path is None else sha256(path.read_bytes()).hexdigest()


def everyday_task(artifact: Artifact, setting: Setting) -> Outcome | None:
    """Measure the everyday facts. Each fact counts as one scene. `setting.scenes` is not used."""
    folder = setting.everyday
    if folder is None or facts_file(folder) is None:
        return None
    metrics: dict[str, Metric] = {}
    count = 0
    for line, pairs in ask_everyday(artifact, folder).items():
        hits, questions_asked = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        count += len(pairs)
        if questions_asked.sum():
            metrics[line] = Ratio(hits, questions_asked)
    return Outcome(metrics, count, 0)


def ask_everyday(artifact: Artifact, folder: Path = EVERYDAY) -> Lines:
    """Ask about every fact in the folder.

    Raises:
        FileNotFoundError: the folder contains no facts.
    """
    path = facts_file(folder)
    if path is None:
        raise FileNotFoundError(f"{folder} contains no facts.json")
    facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return (
        _relations(artifact, facts["relations"])
        | _missing(artifact, "missing", facts["missing"])
        | _missing(artifact, "missing_at", facts["missing_at"])
        | _outliers(artifact, facts["intruders"], facts["plain"])
        | _scenes(artifact, facts["rooms"], facts["seeds"])
    )


def _scene(artifact: Artifact, labels: Sequence[str]) -> Scene:
    """Build a scene of the known labels; several objects of a label have the ids label_number."""
    objects = []
    ids: set[str] = set()
    for label in labels:
        name, number = label, 0
        while name in ids or (number == 0 and labels.count(label) > 1):
            number += 1
            name = f"{label}_{number}"
        ids.add(name)
        if (index := artifact.vocabulary.index(label)) is not None:
            objects.append(SceneObject(name, label, index))
    return Scene(tuple(objects))


def _relations(artifact: Artifact, facts: list[dict[str, str]]) -> Lines:
    rows = []
    for fact in facts:
        p = _relation_probabilities(artifact, fact["subject"], fact["object"])
        likeliest = max(p, key=p.__getitem__, default="")
        vertical = max(_VERTICAL & p.keys(), key=p.__getitem__, default="")
        relation = fact["relation"]
        rows.append((likeliest == relation, vertical == relation, p.get(relation, 0.0) >= 0.5))
    return _count_hits(LINES[:3], rows)


def _count_hits(names: Sequence[str], rows: Sequence[Sequence[bool]]) -> Lines:
    """Return the hits of each name, from one row of hits per fact."""
    return {name: [(int(row[k]), 1) for row in rows] for k, name in enumerate(names)}


def _relation_probabilities(artifact: Artifact, subject: str, other: str) -> dict[str, float]:
    """Return the probability of each of the eight relations of the subject to the other object.

    The facts were written before the relations inside and contains existed, so these are left out.
    """
    scene = _scene(artifact, [subject, other])
    answer = questions.relations(artifact, scene, top_k=_RELATIONS, include_opposites=True)
    p: dict[str, float] = {}
    for entry in answer["relations"]:
        name = entry["relation"]
        if name not in _NEWER:
            name = name if entry["subject"] == subject else opposite(name)
            p[name] = max(p.get(name, 0.0), entry["probability"])
    return p


def _missing(artifact: Artifact, name: str, facts: list[dict[str, Any]]) -> Lines:
    hits = [
        [any(entry["label"] in fact["expected"] for entry in _first_missing(artifact, fact))]
        for fact in facts
    ]
    return _count_hits([f"{name}: an expected object is among five"], hits)


def _first_missing(artifact: Artifact, fact: dict[str, Any]) -> list[Fields]:
    """Return the first five answers, or an empty list if the service would reject the request."""
    scene, at = _scene(artifact, fact["objects"]), None
    if "at" in fact:
        if (anchor := _object_index(artifact, scene, fact["at"]["object"])) is None:
            return []
        at = fact["at"]["relation"], anchor
    if not scene.objects:
        return []
    entries: list[Fields] = questions.missing(artifact, scene, top_k=_LISTED, at=at)["missing"]
    return entries


def _object_index(artifact: Artifact, scene: Scene, name: str) -> int | None:
    """Return the index of the object with the id `name`, or of the only object of class `name`."""
    index = artifact.vocabulary.index(name)
    named = [k for k, thing in enumerate(scene.objects) if thing.id == name]
    indices = named or [k for k, thing in enumerate(scene.objects) if thing.class_index == index]
    return indices[0] if len(indices) == 1 else None


def _outliers(
    artifact: Artifact, intruders: list[dict[str, Any]], plain: list[dict[str, Any]]
) -> Lines:
    def ask(labels: Sequence[str]) -> tuple[list[str], set[str]]:
        """Return the labels, the most suspicious first, and the labels of reported outliers."""
        entries = questions.outliers(artifact, _scene(artifact, labels))["outliers"]
        flagged = {entry["label"] for entry in entries if entry["is_outlier"]}
        return [entry["label"] for entry in entries], flagged

    rows = []
    for fact in intruders:
        ranked, flagged = ask([*fact["objects"], fact["intruder"]])
        rows.append((ranked[:1] == [fact["intruder"]], fact["intruder"] in flagged))
    alarms = [[bool(ask(fact["objects"])[1])] for fact in plain]
    return _count_hits(LINES[5:7], rows) | _count_hits(LINES[7:8], alarms)


def _scenes(artifact: Artifact, rooms: list[dict[str, Any]], seeds: list[int]) -> Lines:
    rows = []
    for room, seed in product(rooms, seeds):
        empty = Scene((), room_type=artifact.vocabulary.room_index(room["room"]))
        answer = questions.generate(artifact, empty, count=_DRAWN, seed=seed)
        scenes = [set(scene["objects"]) for scene in answer["scenes"]]
        typical = sum(bool(labels & set(room["one_of"])) for labels in scenes)
        foreign = sum(bool(labels & set(room["never"])) for labels in scenes)
        few = sum(len(labels) < _FEW for labels in scenes)
        rows.append([(count, len(scenes)) for count in (typical, foreign, few)])
    return {name: [row[k] for row in rows] for k, name in enumerate(LINES[8:])}
