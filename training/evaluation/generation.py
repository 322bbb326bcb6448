"""Task T4: compare generated scenes with held-out scenes.

The metrics use only annotated classes without structure. Intervals resample the held-out scenes and
keep the generated scenes fixed.

    MMD²        squared maximum mean discrepancy, unbiased, kernel exp(-Hamming distance/bandwidth);
                by default the bandwidth is the median distance of the held-out scenes
    marginals   sum_i |p_i - q_i| / sum_i q_i over classes; p generated, q held-out frequency
    pairs       Pearson r over pairs of classes of cov(v_i, v_j), generated against held-out
    copies      share of generated scenes with the same set of classes as a training scene
    mirrored    share of related pairs with both a(x, y) and a(y, x). Several instances of a class
                can make both true, so held-out scenes have a share above 0 too
    cycles      share of scenes with an on-top cycle, among scenes with on-top relations. Several
                instances of a class can form a true cycle of classes

Sources: Gretton et al., "A kernel two-sample test" (2012), eq. 3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Protocol
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

from app.questions.generate import STEPS
from app.scene import CANONICAL
from training.batches import SceneTensors, subset
from training.cases import some_scenes
from training.evaluation.metrics import Floats, Metric, Ratio, Resampled
from training.evaluation.relations import transitive_closure
from training.evaluation.setting import Contender, Outcome, Setting
from training.machines import BoltzmannMachine
from training.machines.chain_samples import ChainSamples
from training.machines.edges import present_classes
from training.machines.gibbs import Clamp, State, gibbs_step, run

_RESAMPLES = 200
# Number of held-out scenes for the bandwidth, and number of classes for covariances.
_BANDWIDTH_SCENES = 1000
_COMMON_CLASSES = 200
_CHAINS = 256
_ON_TOP = CANONICAL.index("on-top")


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Contradictory relations in B scenes, between different classes.

    Attributes:
        related: (B,) number of pairs with a canonical relation in at least one direction, summed
            over the relations.
        mirrored: (B,) number of pairs with the relation in both directions, summed likewise.
        stacked: (B,) bool, the scene has an on-top relation.
        cyclic: (B,) bool, the scene has an on-top cycle.
    """

    related: Tensor
    mirrored: Tensor
    stacked: Tensor
    cyclic: Tensor

    @classmethod
    def of(cls, holds: Tensor) -> Contradictions:
        """Count the contradictions of relations (B, A, n, n)."""
        n = holds.shape[-1]
        on = (holds > 0) & ~torch.eye(n, dtype=torch.bool)
        upper = torch.ones(n, n, dtype=torch.bool).triu(1)
        both, either = on & on.mT & upper, (on | on.mT) & upper
        if holds.shape[1] > _ON_TOP and n:
            stacks = on[:, _ON_TOP]
        else:
            stacks = torch.zeros(len(holds), 1, 1, dtype=torch.bool)
        return cls(
            either.flatten(1).sum(1),
            both.flatten(1).sum(1),
            stacks.flatten(1).any(1),
            transitive_closure(stacks).diagonal(dim1=-2, dim2=-1).any(1),
        )

    @classmethod
    def joined(cls, parts: Sequence[Contradictions]) -> Contradictions:
        """Concatenate the scenes of all parts."""
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def at(self, index: Tensor) -> Contradictions:
        """Select the scenes at the given indices."""
        return Contradictions(*(getattr(self, f.name)[index] for f in fields(self)))

    def metrics(self) -> dict[str, Metric]:
        """Return the shares of mirrored relations and on-top cycles that are defined."""
        shares = {
            "mirrored relations": (self.mirrored, self.related),
            "on-top cycles": (self.cyclic, self.stacked),
        }
        return {
            name: Ratio(some.double().numpy(), whole.double().numpy())
            for name, (some, whole) in shares.items()
            if whole.any()
        }


@dataclass(frozen=True, eq=False)
class Drawn:
    """B generated scenes.

    Attributes:
        v: (B, V) presence.
        contradictions: contradictions of the relations; None if relations were not generated.
    """

    v: Tensor
    contradictions: Contradictions | None = None


class Sampler(Protocol):
    """Generate one scene per row.

    Args:
        given: (B, V) bool, classes that the scene must contain.
        room: (B,) int64 room types; -1 if the room type is not given.
        seed: seed of the random numbers.
    """

    def __call__(self, given: Tensor, room: Tensor, seed: int) -> Drawn: ...


def drawn_of(scenes: SceneTensors, block: int = 64) -> Drawn:
    """Return held-out scenes in the form of generated scenes."""
    parts = [
        Contradictions.of(scenes.batch(index).holds)
        for index in torch.arange(len(scenes)).split(block)
    ]
    return Drawn(scenes.v, Contradictions.joined(parts))


def independent_sampler(train: SceneTensors) -> Sampler:
    """Return a sampler of independent classes at training frequencies, without relations."""
    frequency = train.v.mean(0)

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:  # noqa: ARG001
        generator = torch.Generator().manual_seed(seed)
        v = torch.rand(given.shape, generator=generator) < frequency
        return Drawn((v | given).to(train.v.dtype))

    return sample


def scene_sampler(scenes: SceneTensors) -> Sampler:
    """Return a sampler of real scenes, which estimates the best possible value of a metric.

    Without given classes, row k returns scene k if its room type fits. Otherwise the sampler
    returns a random scene that satisfies the row.

    Raises:
        ValueError: no scene satisfies a row.
    """
    real = drawn_of(scenes)

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:
        rng = np.random.default_rng(seed)
        free = not bool(given.any())
        chosen = []
        for row in range(len(given)):
            fits = (scenes.v >= given[row].to(scenes.v.dtype)).all(1)
            if room[row] >= 0:
                fits &= scenes.room == room[row]
            places = fits.nonzero().squeeze(1).numpy()
            if not len(places):
                raise ValueError(f"no scene satisfies the conditions of row {row}")
            own = free and row in places
            chosen.append(row if own else int(rng.choice(places)))
        index = torch.tensor(chosen)
        found = real.contradictions
        return Drawn(real.v[index], None if found is None else found.at(index))

    return sample


def machine_sampler(machine: BoltzmannMachine, *, steps: int = STEPS) -> Sampler:
    """Return a sampler with the Gibbs chains of the service and the relations of the machine.

    The service keeps only one of a(x, y) and a(y, x); here both may hold.

    Args:
        steps: number of sweeps of a chain.
    """
    samples = ChainSamples(machine)

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:
        generator = torch.Generator().manual_seed(seed)
        parts = []
        for index in torch.arange(len(given)).split(_CHAINS):
            clamp = Clamp(v=given[index], room=room[index] if machine.spec.C else None)
            state = samples.start(given[index].to(machine.b.dtype), generator, clamp)
            state = _sweep(machine, state, generator, clamp, steps)
            parts.append((state.v, Contradictions.of(_grid(machine, state))))
        objects, found = zip(*parts, strict=True)
        return Drawn(torch.cat(objects), Contradictions.joined(found))

    return sample


def _sweep(
    machine: BoltzmannMachine, state: State, generator: torch.Generator, clamp: Clamp, steps: int
) -> State:
    """Run Gibbs sweeps; in the local form only the last sweep samples relations."""
    always = machine.relations_act
    state = run(machine, state, generator, steps - 1, clamp, relations=always)
    return gibbs_step(machine, state, generator, clamp)


def _grid(machine: BoltzmannMachine, state: State) -> Tensor:
    """Return the relations between present classes, (B, A, n, n)."""
    r = state.r * state.edges.ends_present(state.v)
    return machine.between(state.edges, r, present_classes(state.v)).clamp(min=0)


def held_out_halves(setting: Setting) -> tuple[SceneTensors, SceneTensors]:
    """Split held-out scenes into reference scenes and scenes that serve as the best sample.

    A group stays in one half. The limit of the setting applies to each half.
    """
    scenes = setting.scenes
    odd = torch.tensor([crc32(scene.group.encode()) % 2 for scene in scenes.scenes]).bool()
    first, second = (subset(scenes, some.nonzero().squeeze(1)) for some in (~odd, odd))
    return (
        some_scenes(first, setting.limit, setting.seed),
        some_scenes(second, setting.limit, setting.seed),
    )


def hamming(x: Tensor, y: Tensor) -> Tensor:
    """Return Hamming distances (N, M) of binary rows (N, V) and (M, V)."""
    return (x.sum(1, keepdim=True) + y.sum(1) - 2 * x @ y.T).clamp(min=0)


def median_distance(v: Tensor) -> float:
    """Return the median Hamming distance between two scenes, at least 1."""
    v = v[:_BANDWIDTH_SCENES]
    row, column = torch.triu_indices(len(v), len(v), 1)
    return max(1.0, float(hamming(v, v)[row, column].median()))


def discrepancy(held_out: Tensor, drawn: Tensor, bandwidth: float) -> Callable[[Floats], float]:
    """Return MMD² as a function of the weights of the held-out scenes.

    The statistic excludes pairs of a scene with itself or with its copy in a resample.
    """

    def kernel(x: Tensor, y: Tensor) -> Floats:
        return torch.exp(-hamming(x, y) / bandwidth).double().numpy()

    yy, xx = kernel(held_out, held_out), kernel(drawn, drawn)
    xy = kernel(drawn, held_out).mean(0)
    n = len(xx)
    within = float((xx.sum() - np.trace(xx)) / (n * (n - 1)))
    np.fill_diagonal(yy, 0.0)

    def at(weight: Floats) -> float:
        pairs = weight.sum() ** 2 - (weight**2).sum()
        if not pairs > 0:
            return float("nan")
        across = weight @ xy / weight.sum()
        return float(within + weight @ yy @ weight / pairs - 2 * across)

    return at


def marginal_error(held_out: Floats, drawn: Floats) -> Callable[[Floats], float]:
    """Return sum |p - q| / sum q as a function of the weights of the held-out scenes."""
    p = drawn.mean(0)

    def at(weight: Floats) -> float:
        q = weight @ held_out
        if not q.sum() > 0:
            return float("nan")
        return float(np.abs(p - q / weight.sum()).sum() / q.sum() * weight.sum())

    return at


def pair_correlation(held_out: Floats, drawn: Floats) -> Callable[[Floats], float]:
    """Return Pearson r of the covariances of all pairs of the most common held-out classes."""
    common = np.argsort(-held_out.sum(0), kind="stable")[:_COMMON_CLASSES]
    common = common[held_out[:, common].any(0)]
    x, y = drawn[:, common], held_out[:, common]
    pair = np.triu_indices(len(common), 1)

    def covariance(v: Floats, weight: Floats) -> Floats:
        total = weight.sum()
        mean = weight @ v / total
        return ((v.T * weight) @ v / total - np.outer(mean, mean))[pair]

    ours = covariance(x, np.ones(len(x)))

    def at(weight: Floats) -> float:
        if not weight.sum() > 0:
            return float("nan")
        theirs = covariance(y, weight)
        if len(ours) < 2 or not ours.std() or not theirs.std():
            return float("nan")
        return float(np.corrcoef(ours, theirs)[0, 1])

    return at


def copies(drawn: Tensor, train: Tensor) -> Floats:
    """Return (B,) 1 where a generated scene has the same set of classes as a training scene."""
    known = {row.tobytes() for row in np.packbits(train.numpy() > 0, axis=1)}
    rows = np.packbits(drawn.numpy() > 0, axis=1)
    return np.array([row.tobytes() in known for row in rows], dtype=np.float64)


def generation_metrics(
    drawn: Drawn,
    held_out: Tensor,
    train: Tensor,
    asked: Tensor,
    bandwidth: float,
    emphasis: Tensor | None = None,
) -> dict[str, Metric]:
    """Compute all metrics of T4.

    Args:
        drawn: at least two generated scenes.
        held_out: (N, V) presence.
        train: (T, V) presence.
        asked: (V,) bool, the classes that the metrics use.
        emphasis: (N,) weights of the held-out scenes; 1 by default.
    """
    x, y, known = drawn.v[:, asked], held_out[:, asked], train[:, asked]
    ours, theirs = x.double().numpy(), y.double().numpy()
    each = np.ones(len(y)) if emphasis is None else emphasis.double().numpy()

    def resampled(statistic: Callable[[Floats], float]) -> Resampled:
        return Resampled.of(lambda weight: statistic(weight * each), len(y), len(x), _RESAMPLES)

    metrics: dict[str, Metric] = {
        "MMD²": resampled(discrepancy(y, x, bandwidth)),
        "marginal error": resampled(marginal_error(theirs, ours)),
        "classes per scene": Ratio.of_scenes(ours.sum(1)),
        "copies of training scenes": Ratio.of_scenes(copies(x, known)),
    }
    pairs = resampled(pair_correlation(theirs, ours))
    if np.isfinite(pairs.value):
        metrics["pair correlation"] = pairs
    if drawn.contradictions is not None:
        metrics |= drawn.contradictions.metrics()
    return metrics


def generation_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Measure T4: compare generated scenes with the first half of the held-out scenes.

    The number of generated scenes is the size of the second half. There are three conditions:
    without evidence, with the room types of the second half, and with one given class. The given
    class is drawn from all class mentions of the second half. So the probability of a scene is
    proportional to its number of classes. In this condition the first half has the same weights, so
    that a perfect sampler has no discrepancy.
    """
    if contender.sampler is None or setting.train is None:
        return None
    first, second = held_out_halves(setting)
    asked = first.annotated_classes[first.source].any(0) & ~setting.structure
    mentions = ((second.v > 0) & asked).nonzero()
    if min(len(first), len(second), len(mentions)) < 2 or not first.v[:, asked].any():
        return None
    bandwidth = median_distance(first.v[:, asked])
    nothing = torch.zeros_like(second.v, dtype=torch.bool)
    nowhere = torch.full_like(second.room, -1)
    order = np.random.default_rng(setting.seed).permutation(len(mentions))[: len(second)]
    classes = mentions[torch.from_numpy(order), 1]
    one = nothing[: len(classes)].scatter(1, classes.unsqueeze(1), True)
    size = first.v[:, asked].sum(1)
    conditions = {
        "free": (nothing, nowhere, None),
        "given room types": (nothing, second.room, None),
        "given one class": (one, nowhere[: len(one)], size),
    }
    metrics: dict[str, Metric] = {}
    for name, (given, room, emphasis) in conditions.items():
        drawn = contender.sampler(given, room, setting.seed)
        found = generation_metrics(drawn, first.v, setting.train.v, asked, bandwidth, emphasis)
        metrics |= {f"{metric}, {name}": value for metric, value in found.items()}
    notes = {"bandwidth": bandwidth, "held-out scenes": len(first), "drawn scenes": len(second)}
    return Outcome(metrics, len(first), 0, notes)
