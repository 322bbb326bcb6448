"""The variants of the machine, and the specification of its sizes.

A class here defines each variant by its arrays and its relation units. The service needs no other
information about a variant. To add a variant, write a class and add it to `VARIANTS`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, get_args

import numpy as np

from app.inference.relations import FreeUnits, RelationUnits, SharedUnits

if TYPE_CHECKING:
    from app.inference.weights import Weights

Variant = Literal["rbm", "gbm", "triway", "product_rbm"]
Form = Literal["seed", "local"]
Shapes = dict[str, tuple[int, ...]]


def feature_count(relations: int) -> int:
    """Return F = 2A + (2A)² + 4A, the number of features of observed relations."""
    return 2 * relations * (2 * relations + 3)


class RBM:
    """ℓ_t = d_t + U_t·h1 for the T triples of the training scenes; other triples have no unit."""

    factorised: ClassVar[bool] = False
    two_layers: ClassVar[bool] = False
    implications: ClassVar[bool] = False

    @staticmethod
    def shapes(spec: MachineSpec) -> Shapes:
        """Return names and shapes of the arrays that only this variant has."""
        return {"d": (spec.T,), "U": (spec.T, spec.H1)}

    @staticmethod
    def units(weights: Weights) -> RelationUnits:
        """Return the relation units."""
        return FreeUnits(weights, weights["U"])


class GBM(RBM):
    """ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1, with a second hidden layer."""

    two_layers = True

    @staticmethod
    def shapes(spec: MachineSpec) -> Shapes:
        """See `RBM`."""
        return {**RBM.shapes(spec), "g": (spec.T, 2)}

    @staticmethod
    def units(weights: Weights) -> RelationUnits:
        """Return the relation units."""
        return FreeUnits(weights, weights["U"], weights["g"])


class ProductRBM(RBM):
    """An RBM with factorised weights U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]."""

    factorised = True

    @staticmethod
    def shapes(spec: MachineSpec) -> Shapes:
        """See `RBM`."""
        V, A, K, H1 = spec.V, spec.A, spec.K, spec.H1
        return {"d": (spec.T,), "S": (V, K), "O": (V, K), "M": (A, K, H1), "P": (A, H1)}

    @staticmethod
    def units(weights: Weights) -> RelationUnits:
        """Return the relation units."""
        relation, subject, object_ = weights["triples"].astype(np.int64).T
        product = weights["S"][subject] * weights["O"][object_]
        rows = weights["P"][relation]
        for a, shared in enumerate(weights["M"]):
            rows[relation == a] += product[relation == a] @ shared
        return FreeUnits(weights, rows)


class Triway:
    """A unit for every triple, ℓ_e = w_e + U_e·h1, with shared weights and a sparse residual w'.

    w_e = d_a + s[a,i] + o[a,j] + sum_k S[i,k] R[a,k] O[j,k] + n[a]·(log n_i, log n_j) + w'_e
    U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]
    """

    factorised: ClassVar[bool] = True
    two_layers: ClassVar[bool] = True
    implications: ClassVar[bool] = True

    @staticmethod
    def shapes(spec: MachineSpec) -> Shapes:
        """See `RBM`."""
        V, A, K, H1 = spec.V, spec.A, spec.K, spec.H1
        found: Shapes = {
            "d": (A,), "s": (A, V), "o": (A, V), "S": (V, K), "O": (V, K), "R": (A, K),
            "M": (A, K, H1), "P": (A, H1), "n": (A, 2), "usual": (V,), "residual": (spec.T,),
            "kappa": (A,),
        }  # fmt: skip
        if spec.G:
            found |= {"gamma": (1 + spec.G, A, feature_count(A)), "B": (spec.G, H1)}
        return found

    @staticmethod
    def units(weights: Weights) -> RelationUnits:
        """Return the relation units."""
        return SharedUnits(weights)


VARIANTS: Final[dict[str, type[RBM | Triway]]] = {
    "rbm": RBM,
    "gbm": GBM,
    "triway": Triway,
    "product_rbm": ProductRBM,
}

FACTORISED: Final = frozenset(name for name, variant in VARIANTS.items() if variant.factorised)
"""Variants whose relation–context weights are products of factors of rank K."""


@dataclass(frozen=True, slots=True)
class MachineSpec:
    """Sizes and form of one Boltzmann machine.

    Attributes:
        variant: ``rbm``, ``gbm``, ``triway``, or ``product_rbm`` (RBM with the Triway's U).
        V: object classes (visible units v).
        A: canonical relations.
        H1: hidden units of the first layer.
        H2: hidden units of the second layer; 0: no second layer.
        C: room types; a known room type shifts the biases of h1.
        K: rank of the shared tri-way and relation-context weights (Triway, product RBM).
        G: rank of the context's effect on implications between relations (Triway, local form);
            0: no implications.
        T: relation units with their own weight: all units of RBM and GBM, the sparse residual of
            the Triway.
        N: stored persistent-chain samples at which new chains start; 0: no stored samples.
        form: ``seed`` (the energy of the paper) or ``local`` (locally normalised relations).
    """

    variant: Variant
    V: int
    A: int
    H1: int
    H2: int = 0
    C: int = 0
    K: int = 0
    T: int = 0
    G: int = 0
    N: int = 0
    form: Form = "seed"

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise ValueError(f"variant must be one of {get_args(Variant)}, not {self.variant!r}")
        if self.form not in get_args(Form):
            raise ValueError(f"form must be one of {get_args(Form)}, not {self.form!r}")
        for name in ("V", "A", "H1"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("H2", "C", "K", "T", "G", "N"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be at least 0, not {getattr(self, name)}")
        kind = self.kind
        if kind.factorised and self.K < 1:
            raise ValueError(f"a {self.variant} machine needs a rank K of at least 1, not {self.K}")
        if self.G and not (kind.implications and self.is_local):
            raise ValueError(f"G must be 0 unless the machine is a local triway, not {self.G}")
        if self.H2 and not kind.two_layers:
            raise ValueError(f"an RBM has one hidden layer, so H2 must be 0, not {self.H2}")

    @property
    def kind(self) -> type[RBM | Triway]:
        """The class of the variant."""
        return VARIANTS[self.variant]

    @property
    def is_local(self) -> bool:
        """Whether relations are locally normalised."""
        return self.form == "local"

    def to_dict(self) -> dict[str, Any]:
        """Return the specification as JSON-compatible values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> MachineSpec:
        """Build a specification from `to_dict`; raise ValueError for unknown or missing names."""
        known = {field.name for field in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown fields in a machine spec: {unknown}")
        try:
            return cls(**values)
        except TypeError as error:
            raise ValueError(f"incomplete machine spec: {error}") from error
