"""The validated configuration of a training run. The model file contains the configuration."""

from __future__ import annotations

import hashlib
from operator import not_
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from app.inference.variants import VARIANTS, Variant
from app.model.fields import Text, require_printable
from training.datasets.files import position_and_problem
from training.datasets.sources import is_inventory
from training.machines import MachineSpec, build


class ConfigError(ValueError):
    """A configuration is invalid. The message contains the invalid entry and the reason."""


def is_file(source: str) -> bool:
    """Return True if a data source is a file name, and False if it is the name of a source."""
    return "." in Path(source).name


def source_name(source: str) -> str:
    """Return the name of a source: of a file of scenes before the first dot, else the whole."""
    name = Path(source).name
    return name.partition(".")[0] if is_file(source) and not is_inventory(name) else name


def _joined(text: str) -> str:
    return require_printable(" ".join(text.split()))


Line = Annotated[str, AfterValidator(_joined)]
"""A text that may have several lines in the file. The manifest has it on one."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class DataConfig(_Section):
    """The data sources of a run, their vocabulary and the split of their scenes.

    A data source is a name or a file in any known format; a file *.csv is a written inventory. The
    name `rooms` means the built-in generator of rooms, and `inventories` the written places of the
    repository. Any other name means the file `<name>.jsonl.gz` in the data folder (`data_folder`).
    """

    sources: tuple[Text, ...] = Field(min_length=1)
    vocabulary: Text = "written"  # written, source, rooms, or a file that ends in .json
    split: Literal["group", "stable", "final"] = "group"
    split_seed: int = 0
    rooms: int = Field(default=0, ge=0)  # scenes to generate where `rooms` is a source
    # Scenes to draw of each place of a written inventory. A value that `exclude_if` leaves out of
    # the dump preserves the digests of earlier runs.
    written: int = Field(default=0, ge=0, exclude_if=not_)
    limit: int | None = Field(default=None, ge=10)  # maximum scenes of each source
    words: bool = False  # whether word vectors tell similar classes
    terms: Line = Field(default="", exclude_if=not_)  # terms of use of own files
    research_only: bool = Field(default=False, exclude_if=not_)

    @model_validator(mode="after")
    def _distinct(self) -> DataConfig:
        names = [source_name(source) for source in self.sources]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two sources are called {', '.join(twice)}: rename a file")
        return self

    @property
    def files(self) -> bool:
        """True if the configuration names a file as a data source or as the vocabulary."""
        return self.vocabulary.endswith(".json") or any(map(is_file, self.sources))


class MachineConfig(_Section):
    """The variant and the sizes of the machine. The data determine V, A, C and T."""

    variant: Variant
    units: int = Field(default=8, ge=1)  # hidden units
    states: int = Field(default=32, ge=2)  # states of a hidden unit; 2: binary
    coupled: bool = False  # couplings between classes
    K: int = Field(default=32, ge=0)
    G: int = Field(default=0, ge=0)  # rank of the implication factors (Triway)
    N: int = Field(default=1024, ge=0)  # number of stored chain samples
    min_triple_count: int = Field(default=1, ge=1)
    initial_scale: float = Field(default=0.05, gt=0)
    without: tuple[str, ...] = Field(default=(), exclude_if=not_)  # weights held at zero


class ObjectsConfig(_Section):
    """The fit of the object weights (`training.fit.objects`)."""

    steps: int = Field(default=800, ge=1)
    batch_size: int = Field(default=256, ge=1)
    learning_rate: float = Field(default=0.01, gt=0)
    warm_up: int = Field(default=50, ge=1)  # steps in which the rate rises
    leave_one_out: float = Field(default=0.3, ge=0, le=1)  # share of such parts
    room_share: float = Field(default=0.15, ge=0, le=1)  # share of listed room types
    weight_prior: float = Field(default=1.5, ge=0)  # precision of W and Q, in numbers of scenes
    coupling_prior: float = Field(default=5.0, ge=0)  # precision of L and Y
    rate_prior: float = Field(default=7.5, ge=0)  # precision of a, y and kappa
    room_loss: float = Field(default=12.0, ge=0)  # weight of the log-likelihood of the room type
    source_loss: float = Field(default=3.0, ge=0)  # weight of the log-likelihood of the data source
    generative_weight: float = Field(default=0.2, ge=0)  # weight of PCD
    chains: int = Field(default=256, ge=1)  # number of persistent chains (PCD)
    # Sweeps of a round of chains that fits u of the served mix.
    served_sweeps: int = Field(default=20, ge=1)
    # Random classes that a sweep of coupled classes draws.
    classes_per_sweep: int = Field(default=250, ge=1)
    word_weight: float = Field(default=1.0, ge=0)  # scale of the word-vector term
    source_weights: dict[str, float] = {}  # of the scenes of a source; default 1, 0: not used
    # Weights of the sources in the base rates that are served; empty: all equal.
    served_sources: dict[str, float] = {}
    # Sources whose validation scenes calibrate the answers about objects; empty: all scenes with
    # complete object lists.
    calibrated_sources: tuple[str, ...] = ()
    open_sources: tuple[str, ...] = ()  # that show every class; empty: those with open vocabulary

    def precision_of(self, name: str) -> float:
        """Return the precision of the normal prior of an object weight, by the name of it."""
        if name in ("W", "Q") or name.startswith("parametrizations.W"):
            return self.weight_prior
        rates = dict.fromkeys(("a", "y", "kappa"), self.rate_prior)
        return (dict.fromkeys(("L", "Y"), self.coupling_prior) | rates).get(name, 0.0)


class RelationsConfig(_Section):
    """The fit of the relation weights (`training.fit.relation_weights`)."""

    epochs: int = Field(default=8, ge=0)  # passes over the scenes; 0: no relations
    learning_rate: float = Field(default=0.01, gt=0)
    batch_size: int = Field(default=64, ge=1)
    averaging: float = Field(default=0.99, ge=0, lt=1)  # decay of average weights
    count_dropout: float = Field(default=0.3, ge=0, le=1)  # share of scenes with hidden counts
    offset_prior: float = Field(default=8.0, ge=0)  # precision of source offsets
    weight_prior: float = Field(default=16.0, ge=0)  # precision of the weights
    word_weight: float = Field(default=1.0, ge=0)  # scale of the word-vector term
    # Weight of relations by source, default 1; below 1: share of the scenes that an epoch draws.
    source_weights: dict[str, float] = {}


class TrainingConfig(_Section):
    """Settings of the whole run."""

    seed: int = 0
    threads: int = Field(default=1, ge=1)


class Config(_Section):
    """The complete configuration of a training run."""

    name: str = Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$")
    description: Line = ""
    # Example scenes for the visual page: indoor, or a file in the data folder that ends in .json.
    examples: Line = Field(default="", exclude_if=not_)  # empty: none
    data: DataConfig
    machine: MachineConfig
    objects: ObjectsConfig = ObjectsConfig()
    relations: RelationsConfig = RelationsConfig()
    training: TrainingConfig = TrainingConfig()

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        """Check entries that depend on each other. Raise ValueError for the first broken rule."""
        kind = VARIANTS[self.machine.variant]
        if self.machine.without:
            # A smallest machine of the variant tells the names of its weights.
            smallest = build(MachineSpec(self.machine.variant, V=1, A=1, units=1, K=1))
            names = [name for name, _ in smallest.named_parameters()]
            if unknown := sorted(set(self.machine.without) - set(names)):
                raise ValueError(
                    f"machine.without: a {self.machine.variant} has no weights "
                    f"{', '.join(unknown)}, only {', '.join(names)}"
                )
        # Each message with the condition that breaks its rule.
        rules = {
            "machine.G is defined for the Triway only: it must be 0": (
                self.machine.G and not kind.factorised
            ),
            "data.rooms must be at least 1, because `rooms` is a source": (
                "rooms" in self.data.sources and not self.data.rooms
            ),
            "data.written must be at least 1, because a source is a written inventory": (
                any(map(is_inventory, self.data.sources)) and not self.data.written
            ),
        }
        if broken := next((message for message, breaks in rules.items() if breaks), None):
            raise ValueError(broken)
        return self

    @property
    def digest(self) -> str:
        """The sha256 of the configuration."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def first_error(error: ValidationError) -> str:
    """Return the position and the problem of the first invalid entry."""
    position, problem = position_and_problem(error)
    return f"{position or 'the file'}: {problem}"
