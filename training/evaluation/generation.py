"""T4: drawn scenes against held-out ones.

Only the classes that may be asked for count (no structure; in one source, those it annotates).
Intervals resample the held-out scenes, with the drawn ones as they are.

    MMD²        squared maximum mean discrepancy, unbiased, kernel exp(-Hamming distance/bandwidth);
                the bandwidth is the median distance of the held-out scenes unless it is given
    marginals   sum_i |p_i - q_i| / sum_i q_i over classes, q held out
    pairs       Pearson r over pairs of classes of cov(v_i, v_j), drawn and held out
    copies      share of drawn scenes whose set of classes is that of a training scene
    mirrored    share of related pairs where a(x, y) and a(y, x) are both on; with several instances
                of a class that can be true, so held-out scenes have some as well
    cycles      share of the scenes with anything on top of another class in which following on-top
                leads back to where it began; the same holds

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
# The bandwidth is taken from so many held-out scenes, and covariances over so many classes.
_BANDWIDTH_SCENES = 1000
_COMMON_CLASSES = 200
_CHAINS = 256
_ON_TOP = CANONICAL.index("on-top")


@dataclass(frozen=True, eq=False)
class Contradictions:
    """What the relations of B scenes say twice, between different classes.

    Attributes:
        related: (B,) unordered pairs × canonical relations with one direction on at least.
        mirrored: (B,) those with both on.
        stacked: (B,) bool, something is on top of something.
        cyclic: (B,) bool, following on-top leads back.
    """

    related: Tensor
    mirrored: Tensor
    stacked: Tensor
    cyclic: Tensor

    @classmethod
    def of(cls, holds: Tensor) -> Contradictions:
        """Of relations (B, A, n, n)."""
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
        """Of all scenes of the parts."""
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def at(self, index: Tensor) -> Contradictions:
        """Of the scenes at the given positions."""
        return Contradictions(*(getattr(self, f.name)[index] for f in fields(self)))

    def metrics(self) -> dict[str, Metric]:
        """Shares, where there is anything to contradict."""
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
    """B scenes.

    Attributes:
        v: (B, V) presence.
        contradictions: of their relations; None where these were not drawn.
    """

    v: Tensor
    contradictions: Contradictions | None = None


class Sampler(Protocol):
    """Draws one scene for each row.

    Args:
        given: (B, V) bool, classes that must be there.
        room: (B,) int64 room types, -1 where none is given.
        seed: of the random numbers.
    """

    def __call__(self, given: Tensor, room: Tensor, seed: int) -> Drawn: ...


def drawn_of(scenes: SceneTensors, block: int = 64) -> Drawn:
    """Held-out scenes as if they had been drawn."""
    parts = [
        Contradictions.of(scenes.batch(index).holds)
        for index in torch.arange(len(scenes)).split(block)
    ]
    return Drawn(scenes.v, Contradictions.joined(parts))


def independent_sampler(train: SceneTensors) -> Sampler:
    """Classes drawn independently with their frequency in training; no relations."""
    frequency = train.v.mean(0)

    def sample(given: Tensor, room: Tensor, seed: int) -> Drawn:  # noqa: ARG001
        generator = torch.Generator().manual_seed(seed)
        v = torch.rand(given.shape, generator=generator) < frequency
        return Drawn((v | given).to(train.v.dtype))

    return sample


def scene_sampler(scenes: SceneTensors) -> Sampler:
    """Real scenes as if they had been drawn: the floor.

    Where no class is given, each row gets the scene in its place if the room type fits; otherwise
    any one that has what is asked for.

    Raises:
        ValueError: there is none.
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
                raise ValueError(f"no scene has what row {row} asks for")
            own = free and row in places
            chosen.append(row if own else int(rng.choice(places)))
        index = torch.tensor(chosen)
        found = real.contradictions
        return Drawn(real.v[index], None if found is None else found.at(index))

    return sample


def machine_sampler(machine: BoltzmannMachine, *, steps: int = STEPS) -> Sampler:
    """Gibbs chains as the service runs them, but with relations as the machine draws them.

    The service keeps one of a(x, y) and a(y, x); here both may be on.

    Args:
        steps: sweeps of a chain.
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
    """Gibbs sweeps. In the local form relations do not act on the rest: the last one draws them."""
    always = machine.relations_act
    state = run(machine, state, generator, steps - 1, clamp, relations=always)
    return gibbs_step(machine, state, generator, clamp)


def _grid(machine: BoltzmannMachine, state: State) -> Tensor:
    """Relations between present classes, (B, A, n, n)."""
    r = state.r * state.edges.ends_present(state.v)
    return machine.between(state.edges, r, present_classes(state.v)).clamp(min=0)


def held_out_halves(setting: Setting) -> tuple[SceneTensors, SceneTensors]:
    """Scenes to compare drawn ones with, and a second half, the floor, each within the limit.

    A group stays together.
    """
    scenes = setting.scenes
    odd = torch.tensor([crc32(scene.group.encode()) % 2 for scene in scenes.scenes]).bool()
    first, second = (subset(scenes, some.nonzero().squeeze(1)) for some in (~odd, odd))
    return (
        some_scenes(first, setting.limit, setting.seed),
        some_scenes(second, setting.limit, setting.seed),
    )


def hamming(x: Tensor, y: Tensor) -> Tensor:
    """Distances (N, M) of binary rows (N, V), (M, V)."""
    return (x.sum(1, keepdim=True) + y.sum(1) - 2 * x @ y.T).clamp(min=0)


def median_distance(v: Tensor) -> float:
    """Median Hamming distance between two scenes, at least 1."""
    v = v[:_BANDWIDTH_SCENES]
    row, column = torch.triu_indices(len(v), len(v), 1)
    return max(1.0, float(hamming(v, v)[row, column].median()))


def discrepancy(held_out: Tensor, drawn: Tensor, bandwidth: float) -> Callable[[Floats], float]:
    """MMD² as a function of how often each held-out scene counts.

    Pairs of a scene with itself, or with a copy of itself in a resample, are left out.
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
    """sum |p - q| / sum q as a function of the held-out scenes' weights."""
    p = drawn.mean(0)

    def at(weight: Floats) -> float:
        q = weight @ held_out
        if not q.sum() > 0:
            return float("nan")
        return float(np.abs(p - q / weight.sum()).sum() / q.sum() * weight.sum())

    return at


def pair_correlation(held_out: Floats, drawn: Floats) -> Callable[[Floats], float]:
    """Pearson r of the covariances of all pairs among the commonest classes held out."""
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
    """(B,) 1 where a drawn scene's set of classes is that of a training scene."""
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
    """Every figure of T4.

    Args:
        drawn: two scenes or more.
        held_out: (N, V) and train: (T, V) presence.
        asked: (V,) bool, the classes that count.
        emphasis: (N,) how much each held-out scene counts; all alike by default.
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
    """T4: as many scenes as there are in a second half of the held-out ones, against the first.

    Free; given the room types of the second half; and given one class each, drawn from all the
    classes that scenes of the second half hold. A scene then comes up as often as it has classes:
    so the first half counts by size there, and a perfect sampler would leave no discrepancy.
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
