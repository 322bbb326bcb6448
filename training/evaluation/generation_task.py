"""Tasks T4: compare generated scenes with held-out scenes.

The metrics use only annotated classes, without structure classes such as walls. For intervals, the
held-out scenes are resampled and the generated scenes are fixed.

    MMD²        squared maximum mean discrepancy, unbiased. The kernel is
                exp(-Hamming distance / bandwidth). The bandwidth is the median distance between
                two held-out scenes
    marginals   sum_i |p_i - q_i| / sum_i q_i over classes i. p_i is the share of generated scenes
                with class i, and q_i is the share of held-out scenes
    pairs       correlation (Pearson r) between the class covariances cov(v_i, v_j) of generated
                scenes and of held-out scenes, over pairs of classes
    copies      share of generated scenes with the same set of classes as a training scene
    mirrored    share of related pairs of classes with both a(x, y) and a(y, x), for a relation a.
                Both can be true if a class has several instances, also in held-out scenes
    cycles      share of scenes with a cycle of on-top relations, among scenes with on-top
                relations. A cycle of classes can be true if a class has several instances

The task T4 rooms measures common room types of homes and offices:

    refused     share of held-out rooms that do not reach the limits of a generated scene of their
                room type (`app.questions.generate.is_within_limits`)
    change of the number of classes
                mean number of classes of generated scenes, divided by that of held-out whole
                rooms, minus 1. The scenes are drawn as the service draws them, without evidence
                ("free"), or with a room type. Only sources of whole rooms
                (`training.datasets.sources`) have sizes: lists of camera frames are parts of rooms

Sources: Gretton et al., "A kernel two-sample test" (2012), eq. 3.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app.inference.chains import Conditions, random_stream
from app.model import SceneModel
from app.questions.generate import STEPS, draw_plausible, is_within_limits
from app.scene import CANONICAL, Scene
from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import some_scenes
from training.datasets.sources import source_of
from training.evaluation.metrics import Metric, Ratio, Resampled, Statistic
from training.evaluation.parts import of_classes
from training.evaluation.setting import Drawn, Evidence, Outcome, Sampler, Setting

_RESAMPLES = 200
_BANDWIDTH_SCENES = 1000  # maximum number of held-out scenes for the bandwidth
_COMMON_CLASSES = 200  # maximum number of classes for the covariances
_ON_TOP = CANONICAL.index("on-top")


def count_contradictions(holds: Float[Tensor, "B A n n"]) -> Int[Tensor, "B 4"]:
    """Count contradictory relations between different classes of each scene.

    The columns are the numbers of pairs with a relation in both directions, and in at least one,
    summed over the relations, and two truth values: an on-top cycle, and an on-top relation.
    """
    n = holds.shape[-1]
    edges = (holds > 0) & ~torch.eye(n, dtype=torch.bool)
    upper = torch.ones(n, n, dtype=torch.bool).triu(1)
    mirrored, related = edges & edges.mT & upper, (edges | edges.mT) & upper
    on_top = torch.zeros(len(holds), 1, 1, dtype=torch.bool)
    if holds.shape[1] > _ON_TOP and n:
        on_top = edges[:, _ON_TOP]
    is_cyclic = transitive_closure(on_top).diagonal(dim1=-2, dim2=-1).any(1)
    has_on_top = on_top.flatten(1).any(1)
    counts = mirrored.flatten(1).sum(1), related.flatten(1).sum(1), is_cyclic, has_on_top
    return torch.stack([count.long() for count in counts], 1)


def contradiction_metrics(counts: Int[Tensor, "B 4"]) -> dict[str, Metric]:
    """Return the shares of mirrored relations and of on-top cycles; none without relations."""
    mirrored, related, cyclic, stacked = counts.double().numpy().T
    parts = {"mirrored relations": (mirrored, related), "on-top cycles": (cyclic, stacked)}
    return {name: Ratio(part, whole) for name, (part, whole) in parts.items() if whole.any()}


def transitive_closure(pairs: Bool[Tensor, "*B n n"]) -> Bool[Tensor, "*B n n"]:
    """Return the pairs of nodes that a chain of the given pairs connects."""
    reach = pairs.float()
    while True:
        longer = ((reach + reach @ reach) > 0).float()
        if torch.equal(longer, reach):
            return reach > 0
        reach = longer


def independent_scenes(evidence: Evidence) -> Drawn:
    """Draw each class independently, with its frequency in training. The room type is not used."""
    generator, train = torch.Generator().manual_seed(evidence.seed), evidence.train
    v = torch.rand(evidence.given.shape, generator=generator) < train.v.mean(0)
    return Drawn((v | evidence.given).to(train.v.dtype), torch.zeros(len(v), 4))


def held_out_scenes(evidence: Evidence) -> Drawn:
    """Return real scenes, to estimate the best possible value of a metric.

    Without given classes, sample k is scene k, which has the given room type in `generation_task`.
    Otherwise it is a random scene with the given classes.
    """
    scenes, given = evidence.held_out, evidence.given
    batches = map(scenes.batch, torch.arange(len(scenes)).split(64))
    contradictions = torch.cat([count_contradictions(batch.holds) for batch in batches])
    if not given.any():
        return Drawn(scenes.v, contradictions)
    rng = np.random.default_rng(evidence.seed)
    has_given = given.float() @ (scenes.v == 0).float().T == 0  # scenes with all given classes
    index = torch.tensor([int(rng.choice(row.nonzero().squeeze(1).numpy())) for row in has_given])
    return Drawn(scenes.v[index], contradictions[index])


def machine_scenes(artifact: SceneModel, evidence: Evidence) -> Drawn:
    """Draw scenes as the service does, and also sample relations.

    Both of two contradictory relations are kept; the service keeps only one.
    """
    objects, contradictions = torch.zeros(evidence.given.shape), []
    rows = zip(evidence.given, evidence.room.tolist(), strict=True)
    for row, (classes, room_type) in enumerate(rows):
        index = classes.nonzero().squeeze(1)
        stated = room_type if room_type >= 0 and artifact.spec.C else None
        chains = artifact.scene_chains.under(Conditions(index.numpy(), observed=None, room=stated))
        listed = replace(of_classes(index.tolist()), room_type=stated)
        stream = random_stream(evidence.seed, row)
        state = draw_plausible(artifact, chains, listed, STEPS, stream)
        objects[row, torch.from_numpy(state.classes)] = 1.0
        holds = torch.from_numpy(state.r).float().unsqueeze(0)
        contradictions.append(count_contradictions(holds))
    return Drawn(objects, torch.cat(contradictions))


def held_out_halves(setting: Setting) -> tuple[SceneTensors, SceneTensors]:
    """Split held-out scenes by groups: reference scenes, and those of an ideal sampler."""
    scenes = setting.scenes
    is_odd = torch.from_numpy(scenes.group_ids % 2 > 0)
    first, second = (
        some_scenes(subset(scenes, mask), setting.limit, setting.seed) for mask in (~is_odd, is_odd)
    )
    return first, second


def median_distance(v: Float[Tensor, "scenes V"]) -> float:
    """Return the median Hamming distance between two scenes, at least 1."""
    return max(1.0, float(torch.pdist(v[:_BANDWIDTH_SCENES], p=0).median()))


def discrepancy(
    held_out: Float[Tensor, "scenes V"], drawn: Float[Tensor, "B V"], bandwidth: float
) -> Statistic:
    """Return MMD² as a function of the weights of the held-out scenes; NaN with fewer than two.

    The statistic excludes pairs of a scene with itself, or with a copy of itself in a resample.
    """

    def kernel(x: Float[Tensor, "N V"], y: Float[Tensor, "M V"]) -> Float[NDArray, "N M"]:
        return torch.exp(-torch.cdist(x, y, p=0) / bandwidth).double().numpy()

    # MMD² = E k(x, x') + E k(y, y') - 2 E k(x, y) for generated scenes x and held-out scenes y.
    xx, yy = kernel(drawn, drawn), kernel(held_out, held_out)
    xy = kernel(drawn, held_out).mean(0)
    n = len(xx)
    mean_xx = float((xx.sum() - np.trace(xx)) / (n * (n - 1)))
    np.fill_diagonal(yy, 0.0)  # pairs of a scene with itself

    def squared_mmd(weight: Float[NDArray, " scenes"]) -> float:
        """Return MMD² with these weights of the held-out scenes."""
        pairs_weight = weight.sum() ** 2 - (weight**2).sum()
        if not pairs_weight > 0:
            return float("nan")
        mean_yy = weight @ yy @ weight / pairs_weight
        return float(mean_xx + mean_yy - 2 * (weight @ xy / weight.sum()))

    return squared_mmd


def marginal_error(held_out: Float[NDArray, "scenes V"], drawn: Float[NDArray, "B V"]) -> Statistic:
    """Return the marginal error as a function of scene weights; NaN without a class."""
    p = drawn.mean(0)

    def error(weight: Float[NDArray, " scenes"]) -> float:
        count = weight @ held_out  # total weight of the held-out scenes with each class
        if not count.sum() > 0:
            return float("nan")
        return float(np.abs(p - count / weight.sum()).sum() / count.sum() * weight.sum())

    return error


def pair_correlation(
    held_out: Float[NDArray, "scenes V"], drawn: Float[NDArray, "B V"]
) -> Statistic:
    """Return the pair correlation as a function of the weights of the held-out scenes.

    It counts the `_COMMON_CLASSES` most frequent held-out classes, and is NaN if r is undefined.
    """
    most_frequent = np.argsort(-held_out.sum(0), kind="stable")[:_COMMON_CLASSES]
    common = most_frequent[held_out[:, most_frequent].any(0)]
    pairs = np.triu_indices(len(common), 1)

    def covariances(
        v: Float[NDArray, "scenes common"], weight: Float[NDArray, " scenes"]
    ) -> Float[NDArray, " pairs"]:
        """Return the weighted covariance of the presence of each pair of common classes."""
        total = weight.sum()
        mean = weight @ v / total
        return ((v.T * weight) @ v / total - np.outer(mean, mean))[pairs]

    of_drawn = covariances(drawn[:, common], np.ones(len(drawn)))
    held_out_common = held_out[:, common]

    def correlation(weight: Float[NDArray, " scenes"]) -> float:
        """Return the correlation over pairs of classes; NaN without variance."""
        if not weight.sum() > 0:
            return float("nan")
        of_held_out = covariances(held_out_common, weight)
        if len(of_drawn) < 2 or not of_drawn.std() or not of_held_out.std():
            return float("nan")
        return float(np.corrcoef(of_drawn, of_held_out)[0, 1])

    return correlation


def copies(drawn: Float[Tensor, "B V"], train: Float[Tensor, "scenes V"]) -> Float[NDArray, " B"]:
    """Return 1 for each generated scene whose classes are those of a training scene, else 0."""
    training_rows = {row.tobytes() for row in np.packbits(train.numpy() > 0, axis=1)}
    rows = np.packbits(drawn.numpy() > 0, axis=1)
    return np.array([row.tobytes() in training_rows for row in rows], dtype=np.float64)


def generation_metrics(
    drawn: Drawn,
    held_out: Float[Tensor, "scenes V"],
    groups: Int[NDArray, " scenes"],
    train: Float[Tensor, "train V"],
    mask: Bool[Tensor, " V"],
    bandwidth: float,
    emphasis: Float[Tensor, " scenes"] | None = None,
) -> dict[str, Metric]:
    """Compute all metrics of T4 over the classes in the mask; `emphasis` weighs held-out scenes."""
    generated, reference, training = drawn.v[:, mask], held_out[:, mask], train[:, mask]
    drawn_v, held_out_v = generated.double().numpy(), reference.double().numpy()
    base = np.ones(len(reference)) if emphasis is None else emphasis.double().numpy()
    count = len(generated)

    def resampled(statistic: Statistic) -> Resampled:
        return Resampled.of(lambda weight: statistic(weight * base), groups, count, _RESAMPLES)

    metrics: dict[str, Metric] = {
        "MMD²": resampled(discrepancy(reference, generated, bandwidth)),
        "marginal error": resampled(marginal_error(held_out_v, drawn_v)),
        "classes per scene": Ratio.of_scenes(drawn_v.sum(1)),
        "copies of training scenes": Ratio.of_scenes(copies(generated, training)),
    }
    pairs = resampled(pair_correlation(held_out_v, drawn_v))
    if np.isfinite(pairs.value):
        metrics["pair correlation"] = pairs
    return metrics | contradiction_metrics(drawn.contradictions)


def generation_task(sample: Sampler, setting: Setting) -> Outcome | None:
    """Measure T4: compare generated scenes with the first half of the held-out scenes.

    As many scenes as the second half has are generated under three conditions: without evidence,
    with the room types of the second half, and with one given class. The given classes are drawn
    from all (scene, class) pairs of the second half. With a given class, each scene of the first
    half is therefore weighted by its number of classes. A perfect sampler then has no discrepancy.
    """
    if setting.train is None:
        return None
    first, second = held_out_halves(setting)
    mask = first.annotated_classes[first.source].any(0) & ~setting.structure
    mentions = ((second.v > 0) & mask).nonzero()
    if min(len(first), len(second), len(mentions)) < 2 or not first.v[:, mask].any():
        return None
    bandwidth = median_distance(first.v[:, mask])
    no_classes, no_rooms = torch.zeros_like(second.v).bool(), torch.full_like(second.room, -1)
    order = np.random.default_rng(setting.seed).permutation(len(mentions))[: len(second)]
    classes = mentions[torch.from_numpy(order), 1]
    one_class = no_classes[: len(classes)].scatter(1, classes.unsqueeze(1), True)
    class_counts = first.v[:, mask].sum(1)
    conditions = {
        "free": (no_classes, no_rooms, None),
        "given room types": (no_classes, second.room, None),
        "given one class": (one_class, no_rooms[: len(one_class)], class_counts),
    }
    metrics: dict[str, Metric] = {}
    truth = first.v, first.group_ids, setting.train.v, mask, bandwidth
    for name, (given, room, emphasis) in conditions.items():
        drawn = sample(Evidence(given, room, setting.seed, setting.train, second))
        values = generation_metrics(drawn, *truth, emphasis)
        metrics |= {f"{metric}, {name}": value for metric, value in values.items()}
    notes = {"bandwidth": bandwidth, "held-out scenes": len(first), "drawn scenes": len(second)}
    return Outcome(metrics, len(first), 0, notes)


ROOMS: Final = ("bedroom", "kitchen", "bathroom", "living room", "office")
FREE: Final = "free"
REFUSED: Final = "refused"
SIZE: Final = "change of the number of classes"

_FEWEST = 10  # held-out scenes of a room type
_DRAWS = 200  # generated scenes of each condition


def generated_rooms_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the task on held-out scenes. The figures of a room type need 10 scenes."""
    names = artifact.vocabulary.room_types
    types = {name: names.index(name) for name in ROOMS if artifact.spec.C and name in names}
    scenes, things = setting.some(), ~setting.structure
    room, present = scenes.room.numpy(), (scenes.v > 0) & things
    metrics: dict[str, Metric] = {}
    is_common = np.isin(room, list(types.values())) & present.any(1).numpy()
    refused = np.zeros(len(scenes))
    for k in np.flatnonzero(is_common):
        classes = present[k].nonzero().squeeze(1).tolist()
        refused[k] = not is_within_limits(artifact, classes, int(room[k]))
    of_type = {name: is_common & (room == t) for name, t in types.items()}
    of_name = {f"{REFUSED}, {name}": mask for name, mask in of_type.items()}
    for name, mask in {REFUSED: is_common, **of_name}.items():
        if mask.sum() >= _FEWEST:
            metrics[name] = Ratio.of_scenes(refused * mask, mask)
    whole = np.array([source_of(scene.source).whole_rooms for scene in scenes.scenes], np.bool_)
    sizes = present.sum(1).double().numpy()  # numbers of classes
    whole_of_type = {name: mask & whole for name, mask in of_type.items()}
    for name, mask in {FREE: whole, **whole_of_type}.items():
        if mask.sum() >= _FEWEST:
            drawn = _drawn_size(artifact, types.get(name), things, setting.seed)
            change, groups = _size_change(drawn, sizes[mask]), scenes.group_ids[mask]
            metrics[f"{SIZE}, {name}"] = Resampled.of(change, groups, _DRAWS, _RESAMPLES)
    return Outcome.over(scenes, metrics, int((~is_common).sum()))


def _drawn_size(
    artifact: SceneModel, room: int | None, things: Bool[Tensor, " V"], seed: int
) -> float:
    """Return the mean number of classes of generated scenes, without structure."""
    chains = artifact.scene_chains.under(Conditions(np.zeros(0, np.int64), None, room))
    evidence, is_thing = Scene((), room_type=room), things.numpy()
    sizes = [
        int(is_thing[draw_plausible(artifact, chains, evidence, STEPS, stream).classes].sum())
        for stream in (random_stream(seed, k) for k in range(_DRAWS))
    ]
    return float(np.mean(sizes))


def _size_change(drawn: float, sizes: Float[NDArray, " scenes"]) -> Statistic:
    """Return the relative change of a mean size against held-out sizes, by scene weights."""
    return lambda weight: float(drawn * weight.sum() / (weight @ sizes) - 1)
