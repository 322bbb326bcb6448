"""The shape of a machine: everything needed to allocate its parameters, and nothing else."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

Variant = Literal["rbm", "gbm", "triway", "product_rbm"]
Form = Literal["seed", "local"]

FACTORISED: frozenset[Variant] = frozenset({"triway", "product_rbm"})
"""Variants whose relation–context weights are shared by factors of rank K."""


def feature_count(relations: int) -> int:
    """F = 2A + (2A)² + 4A features of given relations, for A relations."""
    return 2 * relations * (2 * relations + 3)


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
        G: rank of the context's say in what given relations imply for others (Triway, local form);
            0 leaves implications out.
        T: relation units with a weight of their own: all units of the RBM and GBM, the sparse
            residual of the Triway.
        N: fantasies that chains start from; 0 keeps none.
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
        if self.variant not in get_args(Variant):
            raise ValueError(f"variant must be one of {get_args(Variant)}, not {self.variant!r}")
        if self.form not in get_args(Form):
            raise ValueError(f"form must be one of {get_args(Form)}, not {self.form!r}")
        for name in ("V", "A", "H1"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("H2", "C", "K", "T", "G", "N"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, not {getattr(self, name)}")
        if self.variant in FACTORISED and self.K < 1:
            raise ValueError(f"a {self.variant} machine needs a rank K of at least 1, not {self.K}")
        if self.G and (self.variant != "triway" or self.form != "local"):
            raise ValueError(f"G must be 0 but in a local triway machine, not {self.G}")
        if self.variant in ("rbm", "product_rbm") and self.H2:
            raise ValueError(f"an RBM has one hidden layer: H2 must be 0, not {self.H2}")

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
