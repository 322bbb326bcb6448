"""The variants of the machine, and the specification of its sizes.

Each variant is a class that defines the arrays of the machine. `relations.relation_units` computes
its relation units from these arrays. To add a variant, write a class and add it to `VARIANTS`.
docs/models.md defines the symbols in the formulas.
"""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Final, Literal, Self, get_args

Variant = Literal["rbm", "gbm", "triway"]
Shapes = dict[str, tuple[int, ...]]


def feature_count(relations: int) -> int:
    """Return the number of features of observed relations, F = 2A + (2A)² + 4A, for A relations."""
    return 2 * relations * (2 * relations + 3)


class RBM:
    """RBM: a machine with one relation unit for each of the T triples of the training scenes.

    The logit of unit t is ℓ_t = d_t + U_t·h1.
    """

    factorised: ClassVar[bool] = False

    @staticmethod
    def shapes(spec: "MachineSpec") -> Shapes:
        """Return the names and shapes of the arrays that this variant adds to `layout`."""
        return {"d": (spec.T,), "U": (spec.T, spec.H1)}


class GBM(RBM):
    """GBM: the RBM with two-way weights between each relation unit and its two classes.

    The logit of unit t is ℓ_t = d_t + g_t v_i + g'_t v_j + U_t·h1.
    """

    @staticmethod
    def shapes(spec: "MachineSpec") -> Shapes:
        """Return the arrays of the RBM, and the two-way weights g."""
        return {**RBM.shapes(spec), "g": (spec.T, 2)}


class Triway:
    """Triway: a machine with one relation unit for every triple (a, i, j).

    The units share weights. The sparse residual w' adds an own weight for some triples. The logit
    of unit e is ℓ_e = w_e + U_e·h1, with

    w_e = d_a + s[a,i] + o[a,j] + sum_k S[i,k] R[a,k] O[j,k] + n[a]·(log n_i, log n_j) + w'_e
    U_e = P[a] + sum_k S[i,k] M[a,k] O[j,k]
    """

    factorised: ClassVar[bool] = True

    @staticmethod
    def shapes(spec: "MachineSpec") -> Shapes:
        """Return the names and shapes of the shared weights and of the residual."""
        V, A, K, H1 = spec.V, spec.A, spec.K, spec.H1
        shapes: Shapes = {
            "d": (A,), "s": (A, V), "o": (A, V), "S": (V, K), "O": (V, K), "R": (A, K),
            "M": (A, K, H1), "P": (A, H1), "n": (A, 2), "usual": (V,), "residual": (spec.T,),
        }  # fmt: skip
        if spec.G:
            shapes |= {"gamma": (1 + spec.G, A, feature_count(A)), "B": (spec.G, H1)}
        return shapes


VARIANTS: Final[dict[str, type[RBM | Triway]]] = {"rbm": RBM, "gbm": GBM, "triway": Triway}


@dataclass(frozen=True, slots=True)
class MachineSpec:
    """Sizes of one Boltzmann machine.

    An implication is a change of a relation's logit by other relations. In RBM and GBM, each
    relation unit has an own weight; in the Triway, only the triples of the sparse residual.
    """

    variant: Variant
    V: int  # object classes (visible units v)
    A: int  # canonical relations
    units: int  # hidden units
    states: int = 2  # states of a hidden unit; 2: binary
    C: int = 0  # room types
    K: int = 0  # rank of the weights that relation units share (Triway)
    T: int = 0  # triples (relation, subject class, object class) with an own weight
    G: int = 0  # rank of the effect of h1 on implications (Triway); 0: no implications
    N: int = 0  # stored samples of Gibbs chains, where new chains start
    profiles: int = 0  # data sources with own base rates of the classes
    coupled: bool = False  # whether the machine has couplings L between classes

    @property
    def judges_relations(self) -> bool:
        """Whether the machine has weights of relations."""
        return self.K > 0 or self.T > 0

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise ValueError(f"variant must be one of {get_args(Variant)}, not {self.variant!r}")
        for name in ("V", "A", "units"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.states < 2:
            raise ValueError(f"states must be at least 2, not {self.states}")
        for name in ("C", "K", "T", "G", "N", "profiles"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must be at least 0, not {getattr(self, name)}")
        kind = self.kind
        if kind.factorised and self.K < 1:
            raise ValueError(f"a {self.variant} machine needs a rank K of at least 1, not {self.K}")
        if self.G and not kind.factorised:
            raise ValueError(f"G is {self.G}, but only a triway may have a G above 0")

    @property
    def kind(self) -> type[RBM | Triway]:
        """The class of the variant."""
        return VARIANTS[self.variant]

    @property
    def H1(self) -> int:  # noqa: N802 - the symbol of docs/models.md
        """Number of hidden states with weights: all but the first of each unit."""
        return self.units * (self.states - 1)

    def to_dict(self) -> dict[str, Any]:
        """Return the specification as JSON-compatible values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build a specification from the result of `to_dict`; ValueError if it is invalid."""
        try:
            return cls(**values)
        except TypeError as error:
            raise ValueError(f"a machine spec has wrong fields: {error}") from error
