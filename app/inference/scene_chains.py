"""Scenes drawn by Gibbs chains that run as compiled loops, each with a random stream of its own.

For machines in the local form. A chain starts at a stored scene that suits what is given, makes
its sweeps over h1, h2 and v (with relations given, h1 by Metropolis–Hastings), and draws relations
once, at the end, since in the local form they do not act on the rest.

Stored scenes are weighed by what they make of the evidence before one is drawn,

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

from app.inference import chain_kernels
from app.inference.listed_relations import ListedRelations
from app.inference.mean_field import sigmoid, with_second_layer
from app.inference.philox import Stream
from app.inference.weights import Weights

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]

OTHER_ROOM = np.float32(6.0)
"""What a stored scene of another room type loses of its log weight."""


class Arrays(NamedTuple):
    """Weights as the compiled loops take them; names as in `weights.layout` but for

    A machine with listed relations is one whose factors are h1 itself: K = H1, S_i * O_j = U_e.

    Attributes:
        WT: (H1, V), W the other way round; JT: (H2, H1), J likewise.
        constant: (A·K + A,) R and d, and
        directions: (H1, A·K + A) what each unit of h1 adds to them, M and P.
        start: (A·V + 1,) where the residuals of each (a, i) begin in
        column, residual: (T,) their j and w'.
        gamma, B: of length 0 where relations do not imply each other.
        fantasies: (N, words) int32, scenes as bits, and
        y, mean: (H1, N) the logits of h1 given each, and their sigmoid.
    """

    W: Floats
    WT: Floats
    J: Floats
    JT: Floats
    c2: Floats
    b: Floats
    S: Floats
    O: Floats  # noqa: E741
    R: Floats
    s: Floats
    o: Floats
    n: Floats
    constant: Floats
    directions: Floats
    start: Places
    column: Places
    residual: Floats
    gamma: Floats
    B: Floats
    fantasies: NDArray[np.int32]
    y: Floats
    mean: Floats


class Observed(NamedTuple):
    """Relations that were seen, on or off: E units between the n classes of a scene.

    Attributes:
        classes: (n,) ascending.
        a, i, j: (E,) relation, and places of subject and object class, ordered by relation.
        first: (A + 1,) where those of each relation begin.
        r: (E,) 1 where it holds, else 0.
        z: (K, E) and
        base: (E,) the parts of its logit that depend on nothing else, S_i * O_j and a number.
    """

    classes: Places
    a: Places
    i: Places
    j: Places
    first: Places
    r: Floats
    z: Floats
    base: Floats


@dataclass(frozen=True, slots=True)
class Conditions:
    """What stays as it is in a chain.

    Attributes:
        classes: (n,) int64, ascending, distinct: they are present.
        log_counts: (n,) log of the instances of each.
        a, i, j: (E,) the relations observed between them, ordered by relation: which, and places
            in `classes`.
        r: (E,) whether each holds.
        held, held2: units of h1 and h2 that are held on, distinct.
        room: index of the room type; None where it is not known.
    """

    classes: Places
    log_counts: Floats
    a: Places
    i: Places
    j: Places
    r: Mask
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

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, weights: Weights) -> None:
        if not self.fits(weights):
            raise ValueError("compiled chains need the local form in float32")
        self.machine = weights
        self.listed = None if weights.spec.variant == "triway" else ListedRelations(weights)
        self.arrays = _arrays(weights)

    @staticmethod
    def fits(weights: Weights) -> bool:
        """Whether the machine is one of those that this module is for."""
        return weights.spec.form == "local" and weights["W"].dtype == np.float32

    def given(self, conditions: Conditions, temperature: float = 1.0) -> ConditionedChains:
        """The chains of one request."""
        return ConditionedChains(self, conditions, temperature)

    def bias(self, room: int | None) -> Floats:
        """c1 + Q[t], (H1,)."""
        c1, Q = self.machine["c1"], self.machine["Q"]
        bias: Floats = c1 if room is None or not len(Q) else c1 + Q[room]
        return bias

    def hint(self, room: int | None) -> Floats:
        """What a room type says of each stored scene, (N,)."""
        Q = self.machine["Q"]
        if room is None or not len(Q):
            return np.zeros(self.machine.spec.N, dtype=np.float32)
        own = self.machine["fantasy_rooms"] == room
        if own.any():
            return np.where(own, np.float32(0.0), -OTHER_ROOM)
        hint: Floats = (Q[room][:, None] * self.arrays.mean).sum(0)
        return hint


class ConditionedChains:
    """Chains under the same conditions, each at a stream of its own; see `SceneChains.given`.

    Attributes:
        bias: (H1,) c1 + Q[t].
        observed: the relations that were seen.
    """

    def __init__(self, chains: SceneChains, conditions: Conditions, temperature: float) -> None:
        w = self._arrays = chains.arrays
        self._machine, self._listed = chains.machine, chains.listed
        self._classes, self._held = conditions.classes, conditions.held
        self._held2 = conditions.held2
        self._beta = np.float32(1.0 / temperature)
        self.bias = chains.bias(conditions.room)
        self.observed = _observed(w, conditions, chains.listed)
        self._cumulative = np.zeros(0)
        if len(w.fantasies):
            self._cumulative = chain_kernels.fantasy_weights(
                w, conditions.classes, conditions.held, chains.hint(conditions.room)
            )

    def draw(self, steps: int, stream: Stream) -> Drawn:
        """The end of one chain.

        Args:
            steps: sweeps over contexts and objects.
            stream: of this chain alone; it moves on.
        """
        on, h1, h2 = chain_kernels.start(
            *(self._arrays, self.bias, self._classes, self._held, self._held2),
            *(self._cumulative, stream),
        )
        return self.move(on, h1, h2, steps, stream)

    def move(
        self,
        on: NDArray[np.uint8],
        h1: NDArray[np.uint8],
        h2: NDArray[np.uint8],
        steps: int,
        stream: Stream,
    ) -> Drawn:
        """The same of a chain that stands at presence (V,) and contexts, all changed here."""
        w, beta, observed = self._arrays, self._beta, self.observed
        chain_kernels.sweeps(
            *(w, self.bias, self._classes, self._held, self._held2, observed, beta, steps),
            *(on, h1, h2, stream),
        )
        classes = chain_kernels.places(on)
        logits = self._logits(classes, h1)
        bias, _ = self._context_bias(classes, float(beta))
        r = chain_kernels.relations(w, bias, classes, logits, observed, beta, stream)
        return Drawn(classes, chain_kernels.places(h1), chain_kernels.places(h2), logits, r > 0)

    def _context_bias(self, classes: Places, beta: float = 1.0) -> tuple[Floats, Floats]:
        """c1 + Q[t] + J m2 for present classes, (H1,), and m2 (H2,), the second layer's means."""
        if not self._machine.spec.H2:
            return self.bias, np.zeros(0, np.float32)
        base = self.bias + self._machine["W"][classes].sum(0)
        x, m2 = with_second_layer(self._machine, base[None], beta)
        return (self.bias + (x[0] - base)).astype(np.float32), m2[0]

    def _logits(self, classes: Places, h1: NDArray[np.uint8]) -> Floats:
        """ℓ between the classes, (A, n, n)."""
        if self._listed is None:
            logits: Floats = chain_kernels.relation_logits(self._arrays, classes, h1)
            return logits
        return self._listed.logits(classes, h1.astype(np.float32))

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
        bias, m = self._context_bias(drawn.classes[shown])
        inner = m[(m > 0) & (m < 1)].astype(np.float64)
        entropy = -(inner * np.log(inner) + (1 - inner) * np.log1p(-inner)).sum()
        bound = float(self._machine["c2"] @ m + entropy)
        score: float = chain_kernels.log_score(
            self._arrays, bias, drawn.classes, shown, drawn.logits, kept
        )
        return score + bound


def _observed(w: Arrays, conditions: Conditions, listed: ListedRelations | None) -> Observed:
    classes = conditions.classes
    # Loops are compiled for each memory layout they meet: one is enough.
    a, i, j = map(np.ascontiguousarray, (conditions.a, conditions.i, conditions.j))
    r = conditions.r.astype(np.float32)
    if listed is None:
        z, base = chain_kernels.observed_units(w, classes, conditions.log_counts, a, i, j)
    else:
        # What has no unit says nothing of the context.
        known, rows = listed.find(a, classes[i], classes[j])
        a, i, j = (part[known] for part in (a, i, j))
        r = r[known]
        one = np.ones(len(a), np.float32)
        z, base = np.ascontiguousarray(listed.rows(rows).T), listed.base(rows, one, one)
    first = np.searchsorted(a, np.arange(len(w.R) + 1))
    return Observed(classes, a, i, j, first, r, z, base)


def _arrays(weights: Weights) -> Arrays:
    spec = weights.spec
    A, V, H1, none = spec.A, spec.V, spec.H1, np.zeros
    fantasies = weights["fantasies"] if spec.N else none((0, 0), np.int32)
    y = none((H1, 0), np.float32)
    if spec.N:
        x, _ = with_second_layer(weights, weights["c1"] + weights.scenes @ weights["W"])
        y = np.ascontiguousarray(x.T.astype(np.float32))
    if spec.variant == "triway":
        own = {name: weights[name] for name in ("S", "O", "R", "s", "o", "n", "residual")}
        constant = np.concatenate([weights["R"].reshape(-1), weights["d"]])
        directions = np.concatenate([weights["M"].reshape(-1, H1), weights["P"]]).T
        keys = weights.triple_keys
    else:
        shapes = {"S": (V, 0), "O": (V, 0), "R": (A, H1), "s": (A, V), "o": (A, V), "n": (A, 2)}
        own = {name: none(shape, np.float32) for name, shape in shapes.items()}
        own["residual"] = none(0, np.float32)
        constant = none(A * H1 + A, np.float32)
        directions = np.concatenate([np.tile(np.eye(H1), A), none((H1, A))], 1)
        keys = none(0, np.int64)
    return Arrays(
        **own,
        W=weights["W"],
        WT=np.ascontiguousarray(weights["W"].T),
        J=weights["J"],
        JT=np.ascontiguousarray(weights["J"].T),
        c2=weights["c2"],
        b=weights["b"],
        constant=constant.astype(np.float32),
        directions=np.ascontiguousarray(directions.astype(np.float32)),
        start=np.searchsorted(keys, np.arange(A * V + 1) * V),
        column=keys % V,
        gamma=weights["gamma"] if spec.G else none((0, 0, 0), np.float32),
        B=weights["B"] if spec.G else none((0, 0), np.float32),
        fantasies=fantasies,
        y=y,
        mean=np.ascontiguousarray(sigmoid(y)),
    )
