"""T2 and Rooms: rank of objects that were hidden from a scene, and of the room types of a scene.

    T2     a request lists all classes of a scene but one, or 25 % of its classes. All instances
           of a hidden class are hidden. The request contains no relations, which could reveal a
           hidden object. The parts are drawn three times, see `training.evaluation.parts`
    T2-at  each class with a relation to another class is removed in turn. One of these
           relations, drawn at random, gives its place: the relation, its direction and the
           class at its other end
    T2     with evidence asks twice about two removed classes, in turn: with labels only, and with
           the room type. The result is the paired change of the MRR
    Rooms  a request lists all classes of a scene, or 2 or 4 random classes. The short lists are
           drawn three times. Only scenes with a room type take part, which is not listed. A scene
           whose room type a model cannot name counts as wrong, with the lowest probability

Structure classes are neither listed, nor hidden, nor candidates. Further metrics of T2 list the
structure that the scene annotates. Scenes with fewer than two other classes are skipped, and so are
hidden classes of one family with a listed class, such as a desk lamp beside a lamp. T2-at
excludes relations between equal classes and relations with structure.

Metrics of Rooms:

    top-1, top-3   share of lists whose room type ranks among the first k; expected over ties
    log-loss       mean of -log p of the room type; p is at least `LEAST`
    ECE            calibration error of the likeliest room type's probability, in ten bins of
                   equally many lists

In the metrics "profile named", the request names the data source of the scene. The metrics "real
rooms" are those of the sources of real rooms alone.
"""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from app.model import SceneModel
from app.scene import CANONICAL
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_rng
from training.evaluation.asking import ask_rows, score_missing
from training.evaluation.metrics import Metric, Ratio, Scored, evidence_changes
from training.evaluation.parts import (
    REAL_SOURCES,
    Parts,
    Ranking,
    Size,
    all_but_one,
    draw_parts,
    exactly,
    one_quarter,
    rank_hidden,
    real_sources,
)
from training.evaluation.setting import (
    ObjectScore,
    Outcome,
    PlacedScore,
    Places,
    RoomScore,
    Setting,
    Structure,
    with_room_type,
)

OF_OBJECTS: Final = ("room type",)  # kinds of evidence for objects (T2)

SEEDS: Final = (0, 1, 2)  # seeds of the draws of a question, for each scene

SIZES: Final[dict[str, Size]] = {"one removed": all_but_one, "25 % shown": one_quarter}
"""Parts that T2 lists, by name."""

TOP: Final = (1, 3, 5, 10)  # values of k for top-k accuracy


def rank_missing(
    scenes: SceneTensors,
    structure: Structure,
    score: ObjectScore,
    size: Size = all_but_one,
    *,
    structure_listed: bool = False,
) -> Ranking:
    """Rank the hidden classes of three parts of each scene."""
    parts = draw_parts(scenes, structure, size, SEEDS)
    v = parts.v + scenes.v[parts.scene] * structure if structure_listed else parts.v
    return rank_hidden(parts, structure, ask_rows(score, v))


def missing_task(score: ObjectScore, setting: Setting) -> Outcome | None:
    """Measure T2, without structure and with the structure of the scene.

    The result is None if no scene has a class to hide.
    """
    scenes, structure = setting.some(), setting.structure
    metrics: dict[str, Metric] = {}
    skipped = 0
    for name, size in SIZES.items():
        ranking = rank_missing(scenes, structure, score, size)
        if not len(ranking.target):
            return None
        metrics[f"MRR, {name}"] = ranking.mrr()
        parts = draw_parts(scenes, structure, size, SEEDS)  # those of `rank_missing`
        skipped = parts.skipped
        row, target = parts.hidden.nonzero(as_tuple=True)
        is_related = parts.related[row, target].numpy()
        of_family = Ratio.of_items(parts.scene[row].numpy(), is_related, len(scenes))
        metrics[f"hidden classes of listed families, {name}"] = of_family
        if size is all_but_one:
            metrics |= {f"top-{k}": ranking.top(k) for k in TOP}
            # The targets of a scene with unknown labels are more, and these score 0.
            things = ((scenes.v > 0) & ~structure).sum(1).clamp(min=1).double().numpy()
            share = 1 + np.array([len(scene.unknown) for scene in scenes.scenes]) / things
            mrr = ranking.mrr()
            unknown = Ratio(mrr.numerators, mrr.denominators * share)
            metrics["MRR, unknown labels score 0"] = unknown
        listed = rank_missing(scenes, structure, score, size, structure_listed=True)
        metrics[f"MRR, {name}, structure listed"] = listed.mrr()
    return Outcome.over(scenes, metrics, skipped)


def removed_places(
    scenes: SceneTensors, structure: Structure, seed: int = 0
) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Places]:
    """Return the indices of the scenes, the removed classes, and their places."""
    removals: list[tuple[int, int, int, int, bool]] = []  # the columns of `table` below
    for k, scene in enumerate(scenes.scenes):
        evidence = scene.evidence
        is_thing = ~structure.numpy()[evidence.classes]
        pair = is_thing[:, None] & is_thing & ~np.eye(len(is_thing), dtype=np.bool_)
        triples = np.argwhere(evidence.holds & pair)
        rng = scene_rng(scene, seed)
        for removed in np.unique(triples[:, 1:]):
            own_triples = triples[(triples[:, 1:] == removed).any(1)]
            relation, i, j = own_triples[rng.integers(len(own_triples))].tolist()
            anchor = j if i == removed else i
            target, anchor_class = evidence.classes[[removed, anchor]].tolist()
            removals.append((k, target, relation, anchor_class, bool(i == removed)))
    table = torch.tensor(removals, dtype=torch.int64).reshape(-1, 5)
    row, targets, relations, anchors, outgoing = table.unbind(1)
    v = (scenes.v[row] * ~structure).scatter(1, targets.unsqueeze(1), 0.0)
    counts = torch.zeros_like(v)
    for own, k in zip(counts, row.tolist(), strict=True):
        evidence = scenes.scenes[k].evidence
        own[torch.from_numpy(evidence.classes)] = torch.tensor(evidence.counts).float()
    return row, targets, Places(v, counts * v, relations, anchors, outgoing.bool())


def leave_one_out_at(
    scenes: SceneTensors, structure: Structure, score: PlacedScore, *, seed: int = 0
) -> tuple[Ranking, Int[NDArray, " N"]]:
    """Return the rank of every removed class, as of `rank_hidden`, and its relation."""
    row, target, places = removed_places(scenes, structure, seed)
    related = scenes.relatives_of(places.v)
    # The service never proposes a class of one family with a listed class, so it has no rank.
    mask = ~related.gather(1, target.unsqueeze(1)).squeeze(1)
    row, target, places, related = row[mask], target[mask], places.rows(mask), related[mask]
    values = ask_rows(lambda *columns: score(Places(*columns)), *vars(places).values(), block=16)
    values = values.masked_fill((places.v > 0) | structure | related, -torch.inf)
    return Ranking.of(row, target, values, len(scenes)), places.relation.numpy()


def placed_task(score: PlacedScore, setting: Setting) -> Outcome | None:
    """Measure T2-at: the MRR of removed classes at their places, also by relation."""
    scenes, structure = setting.some(related=True, share=3), setting.structure
    ranking, relation = leave_one_out_at(scenes, structure, score, seed=setting.seed)
    if not len(relation):
        return None
    mrr = ranking.mrr()
    of_relation = {f"MRR, {CANONICAL[a]}": ranking.mrr(relation == a) for a in np.unique(relation)}
    return Outcome.over(scenes, {"MRR": mrr, **of_relation}, mrr.skipped)


def missing_evidence_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure T2 with labels only and with the room type, one class removed."""
    scenes, structure = with_room_type(setting.some()), setting.structure
    # With one question per scene, chance changes the result of a small data source by about 0.01.
    parts = draw_parts(scenes, structure, all_but_one, (setting.seed, setting.seed + 1))
    if not len(parts.v):
        return None
    score = partial(score_missing, artifact)
    without, informed = (
        rank_hidden(parts, structure, ask_rows(score, *columns)).mrr()
        for columns in ((parts.v,), (parts.v, scenes.room[parts.scene]))
    )
    metrics = evidence_changes("MRR", "room type", without, informed)
    return Outcome.over(scenes, metrics, parts.skipped)


LEAST: Final = 1e-4  # least probability of a room type in the log-loss

LISTS: Final[dict[str, tuple[Size, tuple[int, ...]]]] = {
    "all classes": (lambda classes, _: classes, SEEDS[:1]),
    "4 classes": (exactly(4), SEEDS),
    "2 classes": (exactly(2), SEEDS),
}
"""Lists of a scene by name: their number of classes, and the seeds of the draws."""

FIGURES: Final = ("top-1", "top-3", "log-loss", "ECE")


def room_figures(
    scenes: SceneTensors, parts: Parts, score: RoomScore, profile: str = ""
) -> dict[str, Metric]:
    """Return `FIGURES` for lists of scenes with a room type."""
    scene, target, count = parts.scene.numpy(), scenes.room[parts.scene], len(scenes)
    log_p = ask_rows(lambda v: score(v, profile), parts.v)
    # At least three other types rank before a type that the model cannot name.
    is_named = (target < log_p.shape[1]).unsqueeze(1)
    lowest, added = torch.finfo(log_p.dtype).min, int(target.max()) + 4
    log_p = torch.nn.functional.pad(log_p, (0, added), value=lowest)
    log_p = torch.where(is_named, log_p, log_p.scatter(1, target.unsqueeze(1), -torch.inf))
    ranking = Ranking.of(parts.scene, target, log_p, count)
    p, likeliest = log_p.exp().double().max(1)
    hit = (likeliest == target).numpy()
    loss = -log_p.gather(1, target.unsqueeze(1)).squeeze(1).clamp(min=float(np.log(LEAST)))
    return {
        "top-1": ranking.top(1),
        "top-3": ranking.top(3),
        "log-loss": Ratio.of_items(scene, loss.double().numpy(), count),
        "ECE": Scored("ECE", scene, p.numpy(), hit, np.arange(count)),
    }


def rooms_task(score: RoomScore, setting: Setting) -> Outcome | None:
    """Measure the likeliest room types, without and with the named profile."""
    scenes = with_room_type(setting.some())
    sources = {scene.source for scene in scenes.scenes}
    metrics: dict[str, Metric] = {}
    for name, (size, seeds) in LISTS.items():
        parts = draw_parts(scenes, setting.structure, size, seeds)
        if not len(parts.v):
            continue
        kinds = {name: ""} | ({f"{name}, profile named": min(sources)} if len(sources) == 1 else {})
        for kind, profile in kinds.items():
            figures = room_figures(scenes, parts, score, profile)
            metrics |= {f"{figure}, {kind}": metric for figure, metric in figures.items()}
    if sources <= set(REAL_SOURCES):
        metrics |= {f"{name}, real rooms": metric for name, metric in metrics.items()}
    return Outcome.over(scenes, metrics, 0)


def mean_log_p(scenes: SceneTensors, structure: Structure, score: RoomScore) -> float:
    """Return the mean over real sources and lists of log p of the room type.

    Each list counts without and with the named profile. If the scenes contain no source of
    `REAL_SOURCES`, all sources count.

    Raises:
        ValueError: no scene has a room type.
    """
    values = []
    for source, sample in real_sources(with_room_type(scenes)):
        for size, seeds in LISTS.values():
            parts = draw_parts(sample, structure, size, seeds)
            values += [
                -room_figures(sample, parts, score, profile)["log-loss"].value
                for profile in ("", source)
                if len(parts.v)
            ]
    if not values:
        raise ValueError("no scene has a room type")
    return float(np.mean(values))
