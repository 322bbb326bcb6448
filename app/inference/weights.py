"""The weights of a trained machine: one layout of arrays for every variant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.inference.spec import MachineSpec, feature_count

WORD = 32
"""Bits of the words that stored scenes are packed into."""


def layout(spec: MachineSpec) -> dict[str, tuple[type, tuple[int, ...]]]:
    """Kind of number (float or int) and shape of each array of a machine.

    All variants:

        b (V,), c1 (H1,), c2 (H2,), W (V, H1), J (H1, H2), Q (C, H1)
        triples (T, 3) the (a, i, j) that have a weight of their own, sorted
        fantasies (N, ceil(V / 32)) stored scenes as bits; fantasy_rooms (N,) -1 for none

    Triway: d (A,), s and o (A, V), S and O (V, K), R (A, K), M (A, K, H1), P (A, H1), n (A, 2),
    usual (V,), residual (T,), kappa (A,), gamma (1 + G, A, F) and B (G, H1).
    RBM: d (T,), U (T, H1). GBM: the same and g (T, 2). Product RBM: d, S, O, M, P.
    """
    V, A, K, T, H1, H2 = spec.V, spec.A, spec.K, spec.T, spec.H1, spec.H2
    floats: dict[str, tuple[int, ...]] = {
        "b": (V,), "c1": (H1,), "c2": (H2,), "W": (V, H1), "J": (H1, H2), "Q": (spec.C, H1)
    }  # fmt: skip
    ints: dict[str, tuple[int, ...]] = {"triples": (T, 3)}
    if spec.N:
        ints |= {"fantasies": (spec.N, -(-V // WORD)), "fantasy_rooms": (spec.N,)}
    if spec.variant == "triway":
        floats |= {
            "d": (A,), "s": (A, V), "o": (A, V), "S": (V, K), "O": (V, K), "R": (A, K),
            "M": (A, K, H1), "P": (A, H1), "n": (A, 2), "usual": (V,), "residual": (T,),
            "kappa": (A,),
        }  # fmt: skip
        if spec.G:
            floats |= {"gamma": (1 + spec.G, A, feature_count(A)), "B": (spec.G, H1)}
    elif spec.variant == "product_rbm":
        floats |= {"d": (T,), "S": (V, K), "O": (V, K), "M": (A, K, H1), "P": (A, H1)}
    else:
        floats |= {"d": (T,), "U": (T, H1)}
        if spec.variant == "gbm":
            floats["g"] = (T, 2)
    kinds = ((float, floats), (int, ints))
    return {name: (kind, shape) for kind, some in kinds for name, shape in some.items()}


@dataclass(frozen=True, eq=False)
class Weights:
    """The arrays of a machine, by the names of `layout`; nobody changes them.

    Attributes:
        spec: sizes and form.
        arrays: floats in one precision, integers int32.

    Raises:
        ValueError: an array is missing, is one too many or has another shape; triples outside
            (A, V, V), repeated or not sorted.
    """

    spec: MachineSpec
    arrays: Mapping[str, NDArray[Any]]

    def __post_init__(self) -> None:
        expected = {name: shape for name, (_, shape) in layout(self.spec).items()}
        found = {name: array.shape for name, array in self.arrays.items()}
        for name in sorted(expected.keys() | found.keys()):
            if found.get(name) != expected.get(name):
                raise ValueError(
                    f"{name} is {found.get(name, 'missing')}, must be {expected.get(name, 'none')}"
                )
        table = self["triples"].astype(np.int64)
        if (table < 0).any() or (table >= [self.spec.A, self.spec.V, self.spec.V]).any():
            raise ValueError("triples must hold (a, i, j) within (A, V, V)")
        if (np.diff(self.triple_keys) <= 0).any():
            raise ValueError("triples must be distinct and sorted by (a, i, j)")

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name]

    @cached_property
    def triple_keys(self) -> NDArray[np.int64]:
        """(T,) one number for each triple, (a V + i) V + j; ascending."""
        relation, subject, object_ = self["triples"].astype(np.int64).T
        keys: NDArray[np.int64] = (relation * self.spec.V + subject) * self.spec.V + object_
        return keys

    @property
    def scenes(self) -> NDArray[np.float32]:
        """(N, V) presence in the stored scenes; unpacked at each call, since they are large."""
        return unpack_scenes(self["fantasies"], self.spec.V)


def unpack_scenes(packed: NDArray[np.int32], classes: int) -> NDArray[np.float32]:
    """Presence (N, V) of scenes as bits, (N, words)."""
    octets = packed.astype("<i4").view(np.uint8).reshape(len(packed), -1)
    bits = np.unpackbits(octets, axis=1, bitorder="little", count=classes)
    return bits.astype(np.float32)
