"""Scenes drawn by Gibbs chains, each with a random stream of its own.

For machines in the local form. A chain starts at a stored scene and makes its sweeps over h1, h2
and v. With relations given, h1 is drawn by Metropolis–Hastings. Relations are drawn once, at the
end: in the local form they do not act on the other units.

The stored scene is drawn with weights given the evidence,

    log w = sum_{i given} log p(v_i = 1 | h1) + sum_{k held} log p(h1_k = 1)
            - 6 [drawn under another room type than t],

h1 at its mean given the scene. Where no scene was drawn under t, the last term is h1·Q[t].

A chain costs microseconds a sweep, releases the interpreter's lock while it runs, and depends on
nothing but its conditions and its stream: what else is drawn beside it makes no difference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.inference import chain_kernels as kernels
from app.inference.elementary import sigmoid, softplus
from app.inference.relation_kernels import draw_in_groups
from app.inference.relations import NEVER, Ends, Given, RelationUnits, all_pairs
from app.inference.weights import Weights, unpack_scenes

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]
Bits = NDArray[np.uint8]

OTHER_ROOM = np.float32(6.0)
"""What a stored scene of another room type loses of its log weight."""

# Sweeps whose random numbers are drawn at once.
_AT_ONCE = 64


def random_stream(seed: int, place: int) -> np.random.Generator:
    """A stream of its own for each place of each seed.

    Args:
        seed: any number from 0.
        place: from 0; those of one seed are as independent as those of two.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(place,))
    return np.random.Generator(np.random.PCG64(sequence))


class Arrays(NamedTuple):
    """Weights as the compiled loops take them; names as in `weights.layout` but for

    Attributes:
        WT: (H1, V), W the other way round; JT: (H2, H1), J likewise.
        directions: (H1, R K') what each unit of h1 adds to the R K' factors of relation logits.
    """

    W: Floats
    WT: Floats
    J: Floats
    JT: Floats
    b: Floats
    c2: Floats
    directions: Floats


class Observed(NamedTuple):
    """Relations that were seen, on or off: E units.

    Attributes:
        a: (E,) row of the factors: the relation, or 0 where units share none.
        z: (E, K') and
        base: (E,) the parts of its logit that depend on nothing else.
        r: (E,) 1 where it holds, else 0.
    """

    a: Places
    z: Floats
    base: Floats
    r: Floats


@dataclass(frozen=True, slots=True)
class Conditions:
    """What stays as it is in a chain.

    Attributes:
        classes: (n,) int64, ascending, distinct: they are present.
        log_counts: (n,) log of the instances of each.
        given: the relations observed between them; None for none.
        held, held2: units of h1 and h2 that are held on, distinct.
        room: index of the room type; None where it is not known.
    """

    classes: Places
    log_counts: Floats
    given: Given | None
    held: Places
    held2: Places
    room: int | None = None


@dataclass(frozen=True, slots=True)
class Drawn:
    """The end of a chain.

    Attributes:
        classes: (n,) int64, ascending: those present.
        h1, h2: units of the context that are on, ascending.
        logits: (A, n, n) of the relations between them at temperature 1.
        r: (A, n, n) bool, the relations that are on. A class has none to itself but those observed.
    """

    classes: Places
    h1: Places
    h2: Places
    logits: Floats
    r: Mask


class SceneChains:
    """Chains of a machine.

    Args:
        units: of the same machine.

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, weights: Weights, units: RelationUnits | None = None) -> None:
        if not self.fits(weights):
            raise ValueError("compiled chains need the local form in float32")
        self.machine = weights
        self.units = units or weights.spec.kind.units(weights)
        W, J, H1 = weights["W"], weights["J"], weights.spec.H1
        shared = self.units.G.reshape(-1, H1) if len(self.units.G) else np.eye(H1)
        self.arrays = Arrays(
            W=W,
            WT=np.ascontiguousarray(W.T),
            J=J,
            JT=np.ascontiguousarray(J.T),
            b=weights["b"],
            c2=weights["c2"],
            directions=np.ascontiguousarray(shared.T, np.float32),
        )
        # (N, H1) the means of h1 given the stored scenes.
        self.mean: Floats = np.zeros((0, H1), np.float32)
        if weights.spec.N:
            x, _ = weights.with_second_layer(weights["c1"] + weights.scenes @ W)
            self.mean = sigmoid(x).astype(np.float32)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine is one of those that this module is for."""
        return weights.spec.is_local and weights["W"].dtype == np.float32

    def given(self, conditions: Conditions, temperature: float = 1.0) -> ConditionedChains:
        """The chains of one request."""
        return ConditionedChains(self, conditions, temperature)

    def sample_weights(self, conditions: Conditions) -> NDArray[np.float64]:
        """How likely each stored scene is chosen, (N,)."""
        spec, Q, room = self.machine.spec, self.machine["Q"], conditions.room
        total = np.zeros(len(self.mean), np.float32)
        if room is not None and spec.C:
            own = self.machine["fantasy_rooms"] == room
            total += np.where(own, 0, -OTHER_ROOM) if own.any() else self.mean @ Q[room]
        given = conditions.classes
        logits = self.machine["b"][given] + self.mean @ self.machine["W"][given].T
        total -= softplus(-logits).sum(1)
        total += np.log(np.maximum(self.mean[:, conditions.held], 1e-37)).sum(1)
        weight = np.exp(total - total.max()).astype(np.float64)
        share: NDArray[np.float64] = weight / weight.sum()
        return share


class ConditionedChains:
    """Chains under the same conditions, each at a stream of its own; see `SceneChains.given`."""

    def __init__(self, chains: SceneChains, conditions: Conditions, temperature: float) -> None:
        self._chains, self._machine, self._w = chains, chains.machine, chains.arrays
        spec = chains.machine.spec
        self._beta = np.float32(1.0 / temperature)
        self._bias = chains.machine.room_bias(conditions.room)
        self._always, self._held, self._held2 = (
            _marked(size, where)
            for size, where in (
                (spec.V, conditions.classes),
                (spec.H1, conditions.held),
                (spec.H2, conditions.held2),
            )
        )
        self._classes, self._given = conditions.classes, conditions.given
        self._observed = self._observe(conditions)
        self._cumulative = np.zeros(0)
        if spec.N:
            self._cumulative = np.cumsum(chains.sample_weights(conditions))

    def _observe(self, conditions: Conditions) -> Observed:
        given, units = conditions.given, self._chains.units
        if given is None:
            nothing = np.zeros(0, np.float32)
            width = units.G.shape[1] if len(units.G) else self._machine.spec.H1
            return Observed(
                np.zeros(0, np.int64), np.zeros((0, width), np.float32), nothing, nothing
            )
        ends = _present(conditions.classes, given.i, given.j, conditions.log_counts)
        found = units.select(given.a, ends)
        a = found.a if len(units.G) else np.zeros_like(found.a)
        return Observed(a, found.z, found.base, given.r[found.place])

    def draw(self, steps: int, stream: np.random.Generator) -> Drawn:
        """The end of one chain.

        Args:
            steps: sweeps over contexts and objects.
            stream: of this chain alone; it moves on.
        """
        V, H1 = self._w.W.shape
        on, mean = np.zeros(V, np.uint8), sigmoid(self._bias)
        if len(self._cumulative):
            chosen = int(np.searchsorted(self._cumulative[:-1], stream.random(), "right"))
            on = unpack_scenes(self._machine["fantasies"][chosen : chosen + 1], V)[0]
            on, mean = on.astype(np.uint8), self._chains.mean[chosen]
        h1 = (stream.random(H1, np.float32) < mean).astype(np.uint8) | self._held
        h2 = np.zeros_like(self._held2)
        if len(h2):
            m2 = sigmoid(self._machine["c2"] + h1 @ self._machine["J"])
            h2 = (stream.random(len(h2), np.float32) < m2) | self._held2
        return self.move(on | self._always, h1, h2, steps, stream)

    def move(self, on: Bits, h1: Bits, h2: Bits, steps: int, stream: np.random.Generator) -> Drawn:
        """The same of a chain that stands at presence (V,) and contexts, all changed here."""
        numbers = len(on) + 2 * len(h1) + len(h2) + kernels.PROPOSALS
        while steps > 0:
            uniform = stream.random((min(steps, _AT_ONCE), numbers), np.float32)
            kernels.sweeps(
                *(self._w, self._bias, self._always, self._held, self._held2),
                *(self._observed, self._beta, uniform, on, h1, h2),
            )
            steps -= _AT_ONCE
        classes = np.flatnonzero(on)
        logits = self._logits(classes, h1)
        r = self._relations(classes, logits, stream)
        return Drawn(classes, np.flatnonzero(h1), np.flatnonzero(h2), logits, r)

    def _context_bias(self, classes: Places, beta: float = 1.0) -> tuple[Floats, Floats]:
        """x of h1 given present classes, (H1,), and the means of the second layer (H2,)."""
        base = self._bias + self._machine["W"][classes].sum(0)
        x, m2 = self._machine.with_second_layer(base[None], beta)
        return x[0].astype(np.float32), m2[0]

    def _logits(self, classes: Places, h1: Bits) -> Floats:
        """ℓ between the classes, one instance each, (A, n, n)."""
        n, A = len(classes), self._machine.spec.A
        ends = _present(classes, *all_pairs(n), np.zeros(n, np.float32))
        mean, _ = self._chains.units.normal(h1[None].astype(np.float32), ends, known=True)
        return mean.reshape(A, n, n)

    def _relations(self, classes: Places, logits: Floats, stream: np.random.Generator) -> Mask:
        """r between different classes, (A, n, n); observed units keep their value.

        A class stands in no relation to itself but those observed: nothing else depends on these.
        """
        r = np.zeros(logits.shape, np.bool_)
        free = ~np.broadcast_to(np.eye(len(classes), dtype=np.bool_), r.shape)
        given = self._given
        if given is not None:
            where = np.searchsorted(classes, self._classes)
            a, i, j = given.a, where[given.i], where[given.j]
            known = logits[a, i, j] > NEVER / 2
            units = a[known], i[known], j[known]
            r[units], free[units] = given.r[known] > 0, False
        uniform, other = stream.random((2, *r.shape), np.float32)
        if self._machine.spec.G:
            x, _ = self._context_bias(classes, float(self._beta))
            weight = self._chains.units.implication_weights(x, float(self._beta))
            draw_in_groups(weight, self._beta * logits, free, uniform, other, r)
        else:
            r |= free & (uniform < sigmoid(self._beta * logits))
        return r

    def log_score(self, drawn: Drawn, shown: Mask, kept: Mask) -> float:
        """How likely a drawn scene is, up to a constant of the model, at temperature 1.

            b·v + sum_k softplus(x_k) + log p(kept | v, h1)

        Up to log Z this is log p(v), and how well the context that drew the relations explains
        them. A second layer enters by its mean field m: x has J m, and c2·m and the entropy of m
        are added, a lower bound on the sum over h2.

        Args:
            shown: (n,) the classes that count as present.
            kept: (A, n, n) the relations that count as on.
        """
        listed = drawn.classes[shown]
        x, m = self._context_bias(listed)
        inner = m[(m > 0) & (m < 1)].astype(np.float64)
        entropy = -(inner * np.log(inner) + (1 - inner) * np.log1p(-inner)).sum()
        logits = drawn.logits[:, shown][:, :, shown].astype(np.float64)
        on = kept[:, shown][:, :, shown]
        score = self._machine["b"][listed].sum() + softplus(x).sum() + self._machine["c2"] @ m
        return float(score + entropy + (on * logits - softplus(logits)).sum())


def _marked(size: int, where: Places) -> Bits:
    found = np.zeros(size, np.uint8)
    found[where] = 1
    return found


def _present(classes: Places, i: Places, j: Places, log_counts: Floats) -> Ends:
    """The classes at some places, which are certainly there."""
    one = np.ones(i.shape, np.float32)
    return Ends(classes[i], classes[j], log_counts[i], log_counts[j], one, one)
