"""Scenes drawn by Gibbs chains that run as compiled loops, each with a random stream of its own.

For local Triway machines of one layer in float32; all others are drawn by `gibbs`, in blocks of
chains. Both draw from the same distribution: a chain starts at a fantasy that suits what is given
(`fantasies`), makes its sweeps over h1 and v (`gibbs`; with relations given, h1 by
Metropolis–Hastings), and draws relations once, at the end, since in the local form they do not act
on the rest.

A chain costs microseconds a sweep, releases the interpreter's lock while it runs, and depends on
nothing but its conditions and its stream: what else is drawn beside it makes no difference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.boltzmann import chain_kernels
from app.boltzmann.fantasies import OTHER_ROOM
from app.boltzmann.machine import BoltzmannMachine
from app.boltzmann.philox import Stream
from app.boltzmann.triway import Triway

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Weights(NamedTuple):
    """Weights as the compiled loops take them; names as in `Triway` but for

    Attributes:
        WT: (H1, V), W the other way round.
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
        held: hidden units that are held on, distinct.
        room: index of the room type; None where it is not known.
    """

    classes: Places
    log_counts: Floats
    a: Places
    i: Places
    j: Places
    r: Mask
    held: Places
    room: int | None = None


@dataclass(frozen=True, slots=True)
class Drawn:
    """The end of a chain.

    Attributes:
        classes: (n,) int64, ascending: those present.
        h1: units of the context that are on, ascending.
        logits: (A, n, n) of the relations between them at temperature 1.
        r: (A, n, n) bool, the relations that are on. A class has none to itself but those observed.
    """

    classes: Places
    h1: Places
    logits: Floats
    r: Mask


class SceneChains:
    """Chains of a machine whose weights do not change.

    Args:
        machine: most of its weights are read where they lie, so they must stay as they are.

    Raises:
        ValueError: a machine of another kind; see `fits`.
    """

    def __init__(self, machine: BoltzmannMachine) -> None:
        if not isinstance(machine, Triway) or not self.fits(machine):
            raise ValueError("compiled chains need a local Triway of one layer in float32")
        self.weights = _weights(machine)
        self._c1, self._Q = _array(machine.c1), _array(machine.Q)
        self._fantasy_rooms = _fantasy_rooms(machine)

    @staticmethod
    def fits(machine: BoltzmannMachine) -> bool:
        """Whether the machine is one of those that this module is for."""
        spec = machine.spec
        return (
            isinstance(machine, Triway)
            and spec.form == "local"
            and spec.H2 == 0
            and str(machine.W.dtype) == "torch.float32"
        )

    def given(self, conditions: Conditions, temperature: float = 1.0) -> ConditionedChains:
        """The chains of one request."""
        return ConditionedChains(self, conditions, temperature)

    def bias(self, room: int | None) -> Floats:
        """c1 + Q[t], (H1,)."""
        return self._c1 if room is None or not len(self._Q) else self._c1 + self._Q[room]

    def hint(self, room: int | None) -> Floats:
        """What a room type says of each fantasy, (N,); see `fantasies`."""
        nothing = np.zeros(len(self._fantasy_rooms), dtype=np.float32)
        if room is None or not len(self._Q):
            return nothing
        own = self._fantasy_rooms == room
        if own.any():
            return np.where(own, nothing, np.float32(-OTHER_ROOM))
        hint: Floats = (self._Q[room][:, None] * self.weights.mean).sum(0)
        return hint


class ConditionedChains:
    """Chains under the same conditions, each at a stream of its own; see `SceneChains.given`.

    Attributes:
        bias: (H1,) c1 + Q[t].
        observed: the relations that were seen.
    """

    def __init__(self, chains: SceneChains, conditions: Conditions, temperature: float) -> None:
        w = self._weights = chains.weights
        self._classes, self._held = conditions.classes, conditions.held
        self._beta = np.float32(1.0 / temperature)
        self.bias = chains.bias(conditions.room)
        self.observed = _observed(w, conditions)
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
        on, h1 = chain_kernels.start(
            self._weights, self.bias, self._classes, self._held, self._cumulative, stream
        )
        return self.move(on, h1, steps, stream)

    def move(
        self, on: NDArray[np.uint8], h1: NDArray[np.uint8], steps: int, stream: Stream
    ) -> Drawn:
        """The same of a chain that stands at presence (V,) and context (H1,), both changed here."""
        w, beta, observed = self._weights, self._beta, self.observed
        chain_kernels.sweeps(
            w, self.bias, self._classes, self._held, observed, beta, steps, on, h1, stream
        )
        classes = chain_kernels.places(on)
        logits = chain_kernels.relation_logits(w, classes, h1)
        r = chain_kernels.relations(w, self.bias, classes, logits, observed, beta, stream)
        return Drawn(classes, chain_kernels.places(h1), logits, r > 0)

    def log_score(self, drawn: Drawn, shown: Mask, kept: Mask) -> float:
        """b·v + sum_k softplus(x_k) + log p(kept | v, h1) at temperature 1.

        Args:
            shown: (n,) the classes that count as present.
            kept: (A, n, n) the relations that count as on.
        """
        score: float = chain_kernels.log_score(
            self._weights, self.bias, drawn.classes, shown, drawn.logits, kept
        )
        return score


def _observed(w: Weights, conditions: Conditions) -> Observed:
    classes = conditions.classes
    # Loops are compiled for each memory layout they meet: one is enough.
    a, i, j = map(np.ascontiguousarray, (conditions.a, conditions.i, conditions.j))
    z, base = chain_kernels.observed_units(w, classes, conditions.log_counts, a, i, j)
    first = np.searchsorted(a, np.arange(len(w.R) + 1))
    return Observed(classes, a, i, j, first, conditions.r.astype(np.float32), z, base)


def _array(tensor: Any) -> NDArray[Any]:
    """In C order: where the tensor has it, the tensor's own memory."""
    return np.ascontiguousarray(tensor.detach().numpy())


def _weights(machine: Triway) -> Weights:
    spec = machine.spec
    names = ("W", "b", "S", "O", "R", "s", "o", "n", "residual")
    keys = machine.triple_keys.numpy()
    fantasies = np.zeros((0, 0), dtype=np.int32)
    gamma, B = np.zeros((0, 0, 0), dtype=np.float32), np.zeros((0, 0), dtype=np.float32)
    if spec.N:
        fantasies = _array(machine.fantasies)
    y, mean = chain_kernels.fantasy_contexts(fantasies, _array(machine.W), _array(machine.c1))
    if spec.G:
        gamma, B = _array(machine.gamma), _array(machine.B)
    directions = [_array(machine.M).reshape(-1, spec.H1), _array(machine.P)]
    return Weights(
        **{name: _array(getattr(machine, name)) for name in names},
        WT=_array(machine.W.T),
        constant=np.concatenate([_array(machine.R).reshape(-1), _array(machine.d)]),
        directions=np.ascontiguousarray(np.concatenate(directions).T),
        start=np.searchsorted(keys, np.arange(spec.A * spec.V + 1) * spec.V),
        column=keys % spec.V,
        gamma=gamma,
        B=B,
        fantasies=fantasies,
        y=y,
        mean=mean,
    )


def _fantasy_rooms(machine: BoltzmannMachine) -> NDArray[np.int32]:
    if not machine.spec.N:
        return np.zeros(0, dtype=np.int32)
    rooms: NDArray[np.int32] = _array(machine.fantasy_rooms)
    return rooms
