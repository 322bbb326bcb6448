"""Fit the judgement of stated relations, and of the places of boxes.

Each validation scene takes part several times: with true relations, with one of them altered, with
its boxes, and with one moved object (`training.datasets.moved`). Sentences that a program has
parsed contain errors, so they only show how objects are above and under each other. Boxes show many
relations above that no person would mention, so a listed one of boxes is left out.

A logistic regression of each kind of entry gives the log-odds that the entry is wrong
(`app.questions.misplaced`). The alarm lines keep the share of untouched scenes with an alarm.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.special import logit

from app.model import AlarmLine, AlarmLines, Judgement, Misplaced, SceneModel
from app.model.calibration import KINDS, LEAST_ALARM, WEIGHTS
from app.questions.misplaced import (
    BESIDE,
    EXPLAINED,
    OVER_IT,
    POSED,
    TERMS,
    Entries,
    entries_of,
    wrong_log_odds,
)
from app.questions.posterior import Posterior
from app.scene import RelationTable, Scene
from app.scene.scene import boxes_of, observe
from app.scene.spatial_relations import ON_TOP
from training.datasets import EncodedScene
from training.datasets.array_types import Rng, Table
from training.datasets.cases import (
    Triple,
    altered_scene,
    annotated_relations,
    draw_true_relations,
    scene_rng,
)
from training.datasets.moved import (
    has_boxes,
    lifted_or_sunk,
    moved_scene,
    stacked_by_triple,
    untouched_scene,
)
from training.evaluation.outlier_tasks import ALARMS
from training.fit.regression import LEAST_SCENES, RIDGE, at_most, logistic

_SCENES: Final = 250  # maximum scenes of a source
_SOURCE_SCENES: Final = 60  # minimum scenes of a source with its own alarm line
_OF_MOVED: Final = 0.25  # weight of a scene of boxes with an object at a wrong place
_OF_WORDS: Final = 0.1  # weight of an altered on-top that is asked in the words "under"
_LENGTHS: Final = (1, 2, 4, 8, 16, 32)  # numbers of entries to which the alarm lines are fitted
# Share of the alarms that each kind of entry may raise, without boxes and with boxes.
_BUDGET: Final = {
    "lateral": 0.1,
    "support": 0.7,
    "above": 0.1,
    "under": 0.1,
    "on_floor": 0.5,
    "on_object": 0.35,
    "unheld": 0.25,
}


@dataclass(frozen=True, eq=False)
class _Cases(Table):
    """N entries of scenes, in which one entry or no entry is wrong."""

    scene: Int[NDArray, "N"]  # number of the scene
    encoded: Int[NDArray, "N"]  # number of the validation scene from which the scene was made
    source: NDArray[np.str_]
    untouched: Bool[NDArray, "N"]  # True for entries of a scene without a wrong entry
    complete: Bool[NDArray, "N"]  # True for entries of a source that annotates all supports
    kind: Int[NDArray, "N"]
    terms: Float[NDArray, "N terms"]
    wrong: Bool[NDArray, "N"]
    weight: Float[NDArray, "N"]


def fit_misplaced(artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int = 0) -> Misplaced:
    """Return the judgement of each kind of entry. A kind with too few scenes gets None."""
    order = np.random.default_rng(seed).permutation(len(scenes)).tolist()
    some = at_most([scenes[k] for k in order], lambda scene: scene.source, _SCENES)
    cases = _cases(artifact, some, seed)
    if cases is None:
        return Misplaced()
    kinds = {
        name: _fit_kind(cases.rows(cases.kind == kind), _BUDGET[name], posed=kind >= POSED)
        for kind, name in enumerate(KINDS)
    }
    return Misplaced().model_copy(update=kinds)


def _cases(artifact: SceneModel, scenes: Sequence[EncodedScene], seed: int) -> _Cases | None:
    """Ask about each scene several times, and return the usable entries; None without any scene.

    An entry is a judged relation, or a judged box.
    """
    # Columns `encoded`, `source`, `untouched`, `complete` and `weight` of each question, and
    # columns `kind`, `terms` and `wrong` of its entries.
    of_scene: list[tuple[int, str, bool, bool, float]] = []
    of_entries: list[tuple[NDArray, ...]] = []
    for number, encoded in enumerate(scenes):
        # Without annotated supports, stands show nothing.
        shows_all = annotated_relations(encoded)[ON_TOP].any()
        shown = range(len(KINDS) if shows_all else POSED)
        for scene, wrong in _questions(artifact, encoded, seed):
            bare = replace(scene, room_type=None)
            entries = entries_of(artifact, Posterior(artifact, bare), bare)
            is_wrong, usable = _truth(entries, wrong)
            usable &= np.isin(entries.kind, shown)
            # Leave out listed relations above of scenes with boxes, and those with an explanation.
            listed_of_boxes = not bare.has_boxes and encoded.instance_positions is not None
            explained = listed_of_boxes | (entries.terms[:, 0] >= EXPLAINED)
            usable &= (entries.kind != OVER_IT) | ~explained
            weight = _OF_WORDS if wrong in bare.opposites else 1.0
            if bare.has_boxes and wrong is not None:
                weight = _OF_MOVED
            of_scene.append((number, encoded.source, wrong is None, shows_all, weight))
            of_entries.append((entries.kind[usable], entries.terms[usable], is_wrong[usable]))
    if not of_scene:
        return None
    sizes = [len(kind) for kind, *_ in of_entries]
    columns = (np.repeat(column, sizes) for column in zip(*of_scene, strict=True))
    encoded_index, source, untouched, complete, weights = columns
    kind, terms, wrong_entries = (np.concatenate(x) for x in zip(*of_entries, strict=True))
    return _Cases(
        scene=np.repeat(np.arange(len(sizes)), sizes), encoded=encoded_index, source=source,
        untouched=untouched, complete=complete, kind=kind, terms=terms, wrong=wrong_entries,
        weight=weights,
    )  # fmt: skip


def _questions(
    artifact: SceneModel, encoded: EncodedScene, seed: int
) -> Iterator[tuple[Scene, Triple | int | None]]:
    """Yield scenes with their wrong entry: a triple, the index of the moved object, or None."""
    structure, places = artifact.vocabulary.structure, artifact.places
    classes, rng = encoded.instance_classes.tolist(), scene_rng(encoded, seed)
    triples = draw_true_relations(encoded, structure, rng)
    altered = altered_scene(encoded, structure, triples, rng) if triples else None
    if triples and altered:
        scene, false = altered
        unders = [
            (a, i, j)
            for a, i, j in triples
            if a == ON_TOP and places is not None and places.means_under(classes[i], classes[j])
        ]
        yield _stating(scene, triples, unders), None
        yield _stating(scene, scene.triples, unders), false
        if false[0] == ON_TOP:
            yield _stating(scene, scene.triples, [*unders, false]), false
        literal = [triple for triple in triples if triple not in unders]
        stacked = stacked_by_triple(encoded, structure, literal, scene_rng(encoded, seed + 4))
        if stacked is not None:
            yield _stating(scene, *stacked[:1], unders), stacked[1]
    untouched = untouched_scene(encoded, structure, scene_rng(encoded, seed + 1))
    moved = moved_scene(encoded, structure, scene_rng(encoded, seed + 1))
    if untouched is not None and moved is not None:
        sizes = artifact.vocabulary.sizes
        spread, roles = artifact.spread, artifact.roles
        part = _part_of(untouched, scene_rng(encoded, seed + 2))
        cases: list[tuple[Scene, int | None]] = [(untouched, None), (part, None), moved]
        if has_boxes(encoded):
            cases.append(_part_near(*moved, scene_rng(encoded, seed + 2)))
            if case := lifted_or_sunk(encoded, structure, scene_rng(encoded, seed + 3)):
                cases += [case, _part_near(*case, scene_rng(encoded, seed + 5))]
        for shown, wrong in cases:
            yield observe(shown, typical_sizes=sizes, spread=spread, roles=roles), wrong


def _stating(scene: Scene, triples: Sequence[Triple], unders: Collection[Triple]) -> Scene:
    """Return the scene with these relations. It states the triples of ``unders`` as "under"."""
    table = RelationTable.stated(triples, [triple in unders for triple in triples])
    return replace(scene, relations=table)


def _part_of(scene: Scene, rng: Rng) -> Scene:
    """Return the objects near a random one, as a view; with stated relations, the whole scene."""
    if scene.relations is not None:
        return scene
    part, _ = _part_near(scene, int(rng.integers(len(scene.objects))), rng)
    return part


def _part_near(scene: Scene, i: int, rng: Rng) -> tuple[Scene, int]:
    """Return the objects nearest to object i, which a robot sees at once, and its index there.

    The logarithm of their number is uniform, because many views show few objects.
    """
    points, _ = boxes_of(scene.objects, None)
    distance = np.linalg.norm(points - points[i], axis=1)  # objects without a position come last
    distance[i] = -1.0
    count = round(len(points) ** rng.uniform())
    kept = np.sort(np.argsort(distance, kind="stable")[:count]).tolist()
    return replace(scene, objects=tuple(scene.objects[k] for k in kept)), kept.index(i)


def _truth(
    entries: Entries, wrong: Triple | int | None
) -> tuple[Bool[NDArray, "n"], Bool[NDArray, "n"]]:
    """Return which entries are wrong, and for which of them the truth is annotated."""
    every = np.ones(len(entries.kind), np.bool_)
    if wrong is None:
        return ~every, every
    if isinstance(wrong, tuple):
        return (entries.triple == np.array(wrong)).all(1), every
    # Other relations of a moved object may be right or wrong.
    is_wrong = (entries.mover == wrong) & (entries.kind != BESIDE)
    return is_wrong, (entries.triple[:, 1:] != wrong).all(1) | is_wrong


def _fit_kind(cases: _Cases, budget: float, *, posed: bool) -> Judgement | None:
    """Fit the judgement of one kind of entry; None with too few scenes or without any sense."""
    untouched = cases.rows(cases.untouched)
    if len(np.unique(untouched.encoded)) < LEAST_SCENES or not cases.wrong.any():
        return None
    complete = untouched.rows(untouched.complete)
    if len(np.unique(complete.encoded)) >= LEAST_SCENES:
        untouched = complete
    used = cases.terms.std(0) > 0  # mask of the terms in the regression
    weights, intercept = np.zeros(TERMS), 0.0
    while used.any():
        *fitted, intercept = logistic(cases.terms[:, used], cases.wrong, cases.weight, C=RIDGE)
        weights[:] = 0.0
        weights[used] = fitted
        weights[-1] = max(weights[-1], -1.0)  # at most one of n entries is wrong
        if (weights <= 0).all():
            break
        # A likelier relation, and a likelier stand, never make an entry more suspicious.
        used[weights.argmax()] = False
    else:
        return None
    terms = dict(zip(WEIGHTS, weights.tolist(), strict=True))
    silent = AlarmLines(**dict.fromkeys(ALARMS, AlarmLine(intercept=0.0)))
    judgement = Judgement(intercept=intercept, **terms, lines=silent)
    return judgement.model_copy(update={"lines": _alarm_lines(judgement, untouched, budget, posed)})


def _alarm_lines(judgement: Judgement, untouched: _Cases, budget: float, posed: bool) -> AlarmLines:
    """Fit the alarm lines to the highest log-odds among n random entries of untouched scenes.

    Lines of boxes do not depend on n: they are fitted to all entries of each scene.
    """
    log_odds = wrong_log_odds(judgement, untouched.terms)
    rng = np.random.default_rng(0)
    points: dict[str, list[tuple[float, float]]] = {name: [] for name in ALARMS}
    # Entries of a scene are neighbours: split the log-odds where the scene changes.
    starts = np.flatnonzero(np.diff(untouched.scene, prepend=-1))
    lists = np.split(log_odds, starts[1:])
    sources = untouched.source[starts]
    for n in (1,) if posed else _LENGTHS:
        long_enough = [k for k, values in enumerate(lists) if len(values) >= n]
        if len(long_enough) < LEAST_SCENES:
            break
        highest = np.array(
            [rng.permutation(lists[k])[: None if posed else n].max() for k in long_enough]
        )
        for name, share in ALARMS.items():
            limit = hardest_quantile(highest, sources[long_enough], 1 - budget * share)
            points[name].append((float(np.log(n)), limit))
    return AlarmLines(**{name: _line(points[name], LEAST_ALARM[name]) for name in ALARMS})


def _line(points: Sequence[tuple[float, float]], least: float) -> AlarmLine:
    """Fit a line through points (log n, limit of the log-odds), with a slope from 0 to 1.

    Its intercept is at least the log-odds of the probability `least`.
    """
    log_n, limits = np.array(points).T
    slope = min(max(float(np.polyfit(log_n, limits, 1)[0]), 0.0), 1.0) if len(log_n) > 1 else 0.0
    intercept = float(np.mean(limits - slope * log_n))
    return AlarmLine(intercept=max(intercept, float(logit(least))), log_count=slope)


def hardest_quantile(values: Float[NDArray, "N"], sources: NDArray[np.str_], share: float) -> float:
    """Return the highest quantile over the sources; a robot sees one. Small ones count as one."""
    names, sizes = np.unique(sources, return_counts=True)
    small = np.isin(sources, names[sizes < _SOURCE_SCENES])
    masks = [sources == name for name in names[sizes >= _SOURCE_SCENES]]
    masks += [small] if small.any() else []
    highest = max(float(np.quantile(values[mask], share)) for mask in masks)
    # The next larger number, so that a value equal to the quantile is below the limit.
    return float(np.nextafter(highest, np.inf))
