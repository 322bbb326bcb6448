"""The variants of the machine, and the sizes of one.

A variant is one class here: which arrays it has, and which relation units they make. The service
asks nothing else about it. A new variant is a class and an entry of `VARIANTS`.
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
    """F = 2A + (2A)² + 4A features of given relations, for A relations."""
    return 2 * relations * (2 * relations + 3)


class RBM:
    """ℓ_t = d_t + U_t·h1 for the T triples seen in training; other triples have no unit."""

    factorised: ClassVar[bool] = False
    two_layers: ClassVar[bool] = False
    implications: ClassVar[bool] = False

    @staticmethod
    def shapes(spec: MachineSpec) -> Shapes:
        """Arrays beside those that all variants have."""
        return {"d": (spec.T,), "U": (spec.T, spec.H1)}

    @staticmethod
    def units(weights: Weights) -> RelationUnits:
        """Its relation units."""
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
        """Its relation units."""
        return FreeUnits(weights, weights["U"], weights["g"])


class ProductRBM(RBM):
    """An RBM whose U is U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]."""

    factorised = True

    @staticmethod
    def shapes(spec: MachineSpec) -> Shapes:
        """See `RBM`."""
        V, A, K, H1 = spec.V, spec.A, spec.K, spec.H1
        return {"d": (spec.T,), "S": (V, K), "O": (V, K), "M": (A, K, H1), "P": (A, H1)}

    @staticmethod
    def units(weights: Weights) -> RelationUnits:
        """Its relation units."""
        relation, subject, object_ = weights["triples"].astype(np.int64).T
        product = weights["S"][subject] * weights["O"][object_]
        rows = weights["P"][relation]
        for a, shared in enumerate(weights["M"]):
            rows[relation == a] += product[relation == a] @ shared
        return FreeUnits(weights, rows)


class Triway:
    """A unit for every triple, ℓ_e = w_e + U_e·h1; all weights but a sparse residual are shared.

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
        """Its relation units."""
        return SharedUnits(weights)


VARIANTS: Final[dict[str, type[RBM | Triway]]] = {
    "rbm": RBM,
    "gbm": GBM,
    "triway": Triway,
    "product_rbm": ProductRBM,
}

FACTORISED: Final = frozenset(name for name, variant in VARIANTS.items() if variant.factorised)
"""Variants whose relation–context weights are shared by factors of rank K."""


@dataclass(frozen=True, slots=True)
class MachineSpec:
    """Sizes and form of one Boltzmann machine.

    Attributes:
        variant: ``rbm``, ``gbm``, ``triway``, or ``product_rbm`` (RBM with the Triway's U).
        V: object classes (visible units v).
        A: canonical relations.
        H1: hidden units of the first layer.
        H2: hidden units of the second layer; 0 leaves the layer out.
        C: room types that shift the biases of h1 when one is given.
        K: rank of the shared tri-way and relation-context weights (Triway, product RBM).
        G: rank of the context's part in what given relations imply for others (Triway, local form);
            0 leaves implications out.
        T: relation units with a weight of their own: all units of the RBM and GBM, the sparse
            residual of the Triway.
        N: stored chain samples that chains start from; 0 keeps none.
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
                raise ValueError(f"{name} must not be negative, not {getattr(self, name)}")
        kind = self.kind
        if kind.factorised and self.K < 1:
            raise ValueError(f"a {self.variant} machine needs a rank K of at least 1, not {self.K}")
        if self.G and not (kind.implications and self.is_local):
            raise ValueError(f"G must be 0 but in a local triway machine, not {self.G}")
        if self.H2 and not kind.two_layers:
            raise ValueError(f"an RBM has one hidden layer: H2 must be 0, not {self.H2}")

    @property
    def kind(self) -> type[RBM | Triway]:
        """The variant."""
        return VARIANTS[self.variant]

    @property
    def is_local(self) -> bool:
        """Whether relations are locally normalised."""
        return self.form == "local"

    def to_dict(self) -> dict[str, Any]:
        """The spec as JSON-able values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> MachineSpec:
        """Read a spec back; unknown or missing names raise ValueError."""
        known = {field.name for field in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown fields in a machine spec: {unknown}")
        try:
            return cls(**values)
        except TypeError as error:
            raise ValueError(f"incomplete machine spec: {error}") from error
