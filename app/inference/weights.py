"""The weights of a trained machine: their layout for all variants, and the hidden units.

A hidden unit has Z states. h1 has an entry for each state but the first, whose energy is 0: h1 is 1
for the state of the unit, else 0. x are the logits of these entries:

    x = c1 + Q[t] + v'W,   p(z) = exp(x_z) / (1 + sum_z' exp(x_z'))

v is the presence of the classes, t is the room type, and z' runs over the states of the same unit.
For Z = 2, p is sigmoid(x).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import exp
from app.inference.variants import MachineSpec

WORD: Final = 32
"""Number of bits in a word of the packed stored scenes."""

LISTED_SHARES: Final = (0.3, 0.6, 1.0)
"""Upper limits of the listed share of a scene in the bins of kappa. The last row of kappa is for
lists of all classes but one."""


def layout(spec: MachineSpec) -> dict[str, tuple[type, tuple[int, ...]]]:
    """Return the type (float or int) and the shape of each array of a machine.

    All variants have the arrays below. The classes in `variants` add the arrays of each variant.
    `MachineSpec` defines the sizes.

        b (V,), c1 (H1,), e (C,): biases of objects, hidden units and room types
        f (profiles,): biases of the data sources; see `Weights.source_weights`
        W (V, H1), Q (C, H1): weights between h1 and objects, and between h1 and room types
        L (V, V): couplings between classes, symmetric with a diagonal of 0, if `coupled`
        Y (C, V): couplings between room types and classes, if `coupled`
        a (profiles, V): change of b in scenes of a data source, 0 for classes that it cannot show
        y (profiles, C): change of e in scenes of a data source
        u (profiles + 1, V): change of b + a in whole scenes, which Gibbs chains draw. The last row
            is for the mix of data sources that the model serves
        kappa (4, V): change of the log-odds of unlisted classes by the listed share; see
            `LISTED_SHARES`
        triples (T, 3): sorted triples (relation a, subject class i, object class j) with an own
            weight
        fantasies (N, ceil(V / 32)): stored samples of Gibbs chains. Each bit is the presence of
            one class.
        fantasy_rooms (N,): room type of each stored sample, or -1 if unknown
    """
    V, H1 = spec.V, spec.H1
    floats: dict[str, tuple[int, ...]] = {
        "b": (V,), "c1": (H1,), "e": (spec.C,), "W": (V, H1), "Q": (spec.C, H1),
        "f": (spec.profiles,), "a": (spec.profiles, V), "y": (spec.profiles, spec.C),
        "u": (spec.profiles + 1, V), "kappa": (len(LISTED_SHARES) + 1, V),
    }  # fmt: skip
    if spec.coupled:
        floats |= {"L": (V, V), "Y": (spec.C, V)}
    ints: dict[str, tuple[int, ...]] = {"triples": (spec.T, 3)}
    if spec.N:
        ints |= {"fantasies": (spec.N, -(-V // WORD)), "fantasy_rooms": (spec.N,)}
    kinds = ((float, floats | spec.kind.shapes(spec)), (int, ints))
    return {name: (kind, shape) for kind, shapes in kinds for name, shape in shapes.items()}


@dataclass(frozen=True, eq=False)
class Weights:
    """The constant arrays of a machine.

    Raises:
        ValueError: an array is missing, unexpected or of a wrong shape, a triple has an invalid
            index, or the triples are not distinct and sorted.
    """

    spec: MachineSpec
    arrays: Mapping[str, NDArray[Any]]  # those of `layout`: floats of one precision, and int32

    def __post_init__(self) -> None:
        expected = {name: shape for name, (_, shape) in layout(self.spec).items()}
        shapes = {name: array.shape for name, array in self.arrays.items()}
        for name in sorted(expected.keys() | shapes.keys()):
            if shapes.get(name) != expected.get(name):
                raise ValueError(
                    f"array {name} has the shape {shapes.get(name)}, but the spec needs the shape "
                    f"{expected.get(name)} (None means that the array does not exist)"
                )
        triples = self["triples"].astype(np.int64)
        if (triples < 0).any() or (triples >= [self.spec.A, self.spec.V, self.spec.V]).any():
            raise ValueError(
                "a triple (a, i, j) has an invalid index: a must be from 0 to A - 1, and i and j "
                "must be from 0 to V - 1"
            )
        if (np.diff(self.triple_keys) <= 0).any():
            raise ValueError(
                "triples must be distinct and sorted by (a, i, j), but two rows are equal or not "
                "sorted"
            )

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name]

    @property
    def triple_keys(self) -> Int[NDArray, " T"]:
        """The key (a V + i) V + j of each triple (a, i, j), in ascending order."""
        relation, subject, object_ = self["triples"].astype(np.int64).T
        return (relation * self.spec.V + subject) * self.spec.V + object_

    @property
    def chain_samples(self) -> Float[NDArray, "N V"]:
        """Presence of each class in each stored sample. Each access unpacks all samples."""
        return unpack_scenes(self["fantasies"], self.spec.V)

    @property
    def sample_means(self) -> Float[NDArray, "N H1"]:
        """Means of h1 given each stored sample, without its room type."""
        return state_means(self["c1"] + self.chain_samples @ self["W"], self.spec.states)

    def enlarged(self, V: int, C: int) -> "Weights":
        """Return the weights for V classes and C room types. The new ones at the end have 0."""
        spec = replace(self.spec, V=V, C=C)
        arrays = {name: _padded(self[name], shape) for name, (_, shape) in layout(spec).items()}
        return Weights(spec, arrays)

    def room_bias(self, room: int | None) -> Float[NDArray, " H1"]:
        """Return the bias of h1 for a room type t: c1 + Q[t], or c1 without a room type."""
        return self["c1"] if room is None or not self.spec.C else self["c1"] + self["Q"][room]

    def room_couplings(self, room: int | None) -> Float[NDArray, " V"]:
        """Return the change of the log-odds of each class by a room type t: Y[t] or 0."""
        if room is None or not self.spec.C or not self.spec.coupled:
            return np.zeros(self.spec.V, self["b"].dtype)
        return self["Y"][room]

    def source_weights(
        self, classes: Int[NDArray, " n"], presence: Float[NDArray, "N n"], profile: int | None
    ) -> Float[NDArray, "N profiles"]:
        """Return p(q | listed classes) = softmax(f + a v) in N scenes, or 1 for `profile`."""
        if profile is not None:
            one = np.zeros((len(presence), self.spec.profiles))
            one[:, profile] = 1.0
            return one
        return _source_weights(self["f"], self["a"], classes, presence)

    def scene_bias(
        self, classes: Int[NDArray, " n"], profile: int | None, room: int | None
    ) -> tuple[Float[NDArray, " V"], float]:
        """Return the biases of whole scenes for Gibbs chains: of each class, and of the room.

        The bias of a class is b + sum_q p(q) (a[q] + u[q]) + Y[t], and that of the room type t is
        e[t] + sum_q p(q) y[q, t]; see `source_weights`. Without required `classes` and without a
        profile, the mix of data sources determines them.
        """
        bias: NDArray[Any] = self["b"] + self.room_couplings(room)
        of_room = self["e"] if self.spec.C else np.zeros(1)
        if self.spec.profiles and (len(classes) or profile is not None):
            present = np.ones((1, len(classes)), np.float32)
            p = self.source_weights(classes, present, profile)[0]
            bias = bias + p.astype(bias.dtype) @ (self["a"] + self["u"][:-1])
            of_room = of_room + p @ self["y"] if self.spec.C else of_room
        else:
            bias = bias + self["u"][-1]
        return bias, 0.0 if room is None or not self.spec.C else float(of_room[room])


def _padded(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a copy of an array with zeros behind the end of its axes."""
    padded = np.zeros(shape, array.dtype)
    padded[tuple(slice(old) for old in array.shape)] = array
    return padded


def state_means(x: Float[NDArray, "*N H1"], states: int) -> Float[NDArray, "*N H1"]:
    """Return the probabilities of all states of hidden units but the first, given the logits x."""
    p = all_states(x.reshape(-1, x.shape[-1]), states)
    return p[:, :, 1:].reshape(x.shape)


def unpack_scenes(packed: Int[NDArray, "N words"], classes: int) -> Float[NDArray, "N V"]:
    """Convert scenes stored as bits of 32-bit words to the presence of each class."""
    octets = packed.astype("<i4").view(np.uint8).reshape(len(packed), -1)
    bits = np.unpackbits(octets, axis=1, bitorder="little", count=classes)
    return bits.astype(np.float32)


def pack_scenes(presence: NDArray[Any]) -> Int[NDArray, "N words"]:
    """Convert the presence of each class, (N, V), to bits of 32-bit words."""
    bits = np.zeros((len(presence), -(-presence.shape[1] // WORD) * WORD), np.uint8)
    bits[:, : presence.shape[1]] = presence > 0
    return np.packbits(bits, axis=1, bitorder="little").view("<i4").astype(np.int32)


@compiled
def all_states(x: Float[NDArray, "B H1"], states: int) -> Float[NDArray, "B units states"]:
    """Return the softmax over the states of each hidden unit; the first state has the logit 0."""
    others, half, one = states - 1, np.float32(0.5), np.float32(1.0)
    p = np.zeros((len(x), x.shape[1] // others, states), np.float32)
    for b in range(len(p)):
        for m in range(p.shape[1]):
            row, top, total = p[b, m], np.float32(0.0), np.float32(0.0)
            for z in range(others):
                row[z + 1] = x[b, m * others + z]
                top = max(top, row[z + 1])
            # exp() clips below e^-87. The square of e^(x/2) also covers smaller numbers.
            for z in range(states):
                row[z] = exp((row[z] - top) * half)
                row[z] *= row[z]
            for z in range(states):
                total += row[z]
            for z in range(states):
                row[z] *= one / total
    return p


@compiled
def _source_weights(
    f: Float[NDArray, " profiles"],
    a: Float[NDArray, "profiles V"],
    classes: Int[NDArray, " n"],
    presence: Float[NDArray, "N n"],
) -> Float[NDArray, "N profiles"]:
    """Return p(q | classes) = softmax_q(f_q + sum_j a_qj v_j) of each data source q in N scenes s.

    v is the presence of the listed classes j. In float64, terms of 0 (structure) change no sum.
    """
    p = np.empty((len(presence), len(f)), np.float64)
    for s in range(len(presence)):
        top, total = -np.inf, 0.0
        for q in range(len(f)):
            p[s, q] = f[q]
            for j in range(len(classes)):
                p[s, q] += np.float64(a[q, classes[j]]) * presence[s, j]
            top = max(top, p[s, q])
        for q in range(len(f)):
            p[s, q] = math.exp(p[s, q] - top)
            total += p[s, q]
        for q in range(len(f)):
            p[s, q] /= total
    return p
