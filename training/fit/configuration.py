"""The validated configuration of a training run. The model file contains the configuration."""

from __future__ import annotations

import hashlib
from operator import not_
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from app.inference.variants import VARIANTS, Form, Variant
from training.machines import MachineSpec, build


class ConfigError(ValueError):
    """A configuration is invalid. The message contains the invalid entry and the reason."""


def is_file(source: str) -> bool:
    """Return True if a data source is a file name, and False if it is the name of a source."""
    return "." in Path(source).name


def source_name(source: str) -> str:
    """Return the name of a source; for a file, the part of its name before the first dot."""
    return Path(source).name.partition(".")[0] if is_file(source) else source


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class DataConfig(_Section):
    """The data sources of a run, their vocabulary and the split of their scenes.

    A data source is a name or a file in any known format. The name `rooms` means the built-in
    generator of rooms. Any other name means the file `<name>.jsonl.gz` in the data folder
    (`data_folder`).
    """

    sources: tuple[str, ...] = Field(min_length=1)
    vocabulary: str = Field(
        default="indoor", description="indoor, source, rooms, or a file that ends in .json"
    )
    split: Literal["group", "stable", "final"] = "group"
    split_seed: int = 0
    rooms: int = Field(default=0, ge=0, description="scenes to generate where `rooms` is a source")
    limit: int | None = Field(default=None, ge=10, description="maximum scenes of each source")
    words: str = Field(
        default="", description="file of word vectors in the data folder; empty: no vectors"
    )
    # A value that `exclude_if` leaves out of the dump preserves the digests of earlier runs.
    terms: str = Field(default="", exclude_if=not_, description="terms of use of own files")
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
    """The variant and the sizes of the machine.

    The data determine the numbers of classes V, relations A, room types C and triples T.
    """

    variant: Variant
    H1: int = Field(default=200, ge=1)
    H2: int = Field(default=100, ge=0)
    K: int = Field(default=32, ge=0)
    G: int = Field(default=0, ge=0, description="rank of the implication factors (Triway)")
    N: int = Field(default=0, ge=0, description="number of stored chain samples")
    form: Form = "seed"
    min_triple_count: int = Field(default=1, ge=1)
    initial_scale: float = Field(default=0.05, gt=0)
    initial_c1: float = 0.0
    without: tuple[str, ...] = Field(
        default=(), exclude_if=not_, description="names of weights held at zero"
    )


class ObjectiveConfig(_Section):
    """The training objective, and its settings."""

    name: Literal["contrastive_divergence", "persistent_cd", "composite", "relations"]
    k: int = Field(default=1, ge=1, description="Gibbs steps for each update (CD, PCD)")
    chains: int = Field(default=128, ge=1, description="number of persistent chains (PCD)")
    presence_weight: float = Field(default=0.1, ge=0, description="weight of the presence term")
    relation_weight: float = Field(default=0.05, ge=0)
    unlisted: Literal["unobserved", "off"] = Field(
        default="unobserved", description="meaning of unlisted relations in annotated scenes"
    )
    generative_weight: float = Field(default=0.0, ge=0, description="weight of PCD (composite)")
    room_dropout: float = Field(default=0.5, ge=0, le=1, description="share of hidden room types")
    structure_dropout: float = Field(default=0.5, ge=0, le=1)
    object_dropout: float = Field(default=0.0, ge=0, lt=1)
    count_dropout: float = Field(
        default=0.0, ge=0, le=1, description="share of scenes with hidden counts"
    )
    offset_prior: float = Field(
        default=8.0, ge=0, description="precision of the offsets of the sources (relations)"
    )
    weight_prior: float = Field(
        default=16.0, ge=0, description="precision of the relation weights (relations)"
    )
    word_weight: float = Field(
        default=0.0, ge=0, description="scale of the word-vector term (relations)"
    )
    source_weights: dict[str, float] = Field(
        default={}, description="weight of relations by source, default 1 (relations)"
    )


class ObjectsConfig(_Section):
    """The first training phase: objects only, by persistent Gibbs chains.

    The phase needs a machine of the local form (`training.machines.machine`).
    """

    epochs: int = Field(default=0, ge=0, description="passes over the scenes; 0 skips the phase")
    learning_rate: float = Field(default=0.2, gt=0, description="initial rate; falls to 0")
    chains: int = Field(default=64, ge=1)
    batch_size: int = Field(default=32, ge=1)


class FineTuneConfig(_Section):
    """The last training phase, which fine-tunes the weights of objects by persistent chains.

    The phase needs a machine of the local form (`training.machines.machine`).
    """

    updates: int = Field(default=0, ge=0)
    chains: int = Field(default=512, ge=1)
    k: int = Field(default=2, ge=1, description="Gibbs steps for each update")
    learning_rate: float = Field(default=0.002, gt=0)
    anchor: float = Field(default=0.1, ge=0, description="penalty on changes of the weights")


class TrainingConfig(_Section):
    """The optimiser, and the rules that end training."""

    optimiser: Literal["adamw", "sgd"] = "adamw"
    learning_rate: float = Field(default=0.01, gt=0)
    schedule: Literal["one_cycle", "constant"] = "one_cycle"
    epochs: int = Field(default=30, ge=1)
    batch_size: int = Field(default=64, ge=1)
    weight_decay: float = Field(default=0.0, ge=0)
    relation_decay: float = Field(default=0.0, ge=0, description="decay of the relation weights")
    relation_rate: float = Field(default=1.0, gt=0, description="rate factor of relation weights")
    averaging: float = Field(default=0.0, ge=0, lt=1, description="decay of average weights")
    patience: int | None = Field(default=None, ge=1)
    seed: int = 0
    threads: int = Field(default=1, ge=1)
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto",
        exclude_if=lambda device: device == "auto",
        description="device of the epochs; auto: a GPU if there is one",
    )


class Config(_Section):
    """The complete configuration of a training run."""

    name: str = Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$")
    description: str = ""
    examples: str = Field(
        default="",
        exclude_if=not_,
        description="example scenes for the visual page: indoor, or a file in the data folder that "
        "ends in .json; empty: none",
    )
    data: DataConfig
    machine: MachineConfig
    objective: ObjectiveConfig
    training: TrainingConfig = TrainingConfig()
    objects: ObjectsConfig = ObjectsConfig()
    polish: FineTuneConfig = FineTuneConfig()

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        if self.machine.without:
            smallest = build(MachineSpec(self.machine.variant, V=1, A=1, H1=1, K=1))
            names = [name for name, _ in smallest.named_parameters()]
            if unknown := sorted(set(self.machine.without) - set(names)):
                raise ValueError(
                    f"machine.without: a {self.machine.variant} has no weights "
                    f"{', '.join(unknown)}, only {', '.join(names)}"
                )
        kind, local = VARIANTS[self.machine.variant], self.machine.form == "local"
        local_only = {
            "machine.N": self.machine.N,
            "objective.generative_weight": self.objective.generative_weight,
            "objects.epochs": self.objects.epochs,
            "polish.updates": self.polish.updates,
        }
        rules = {
            "machine.H2 must be 0, because this machine.variant has one hidden layer": (
                self.machine.H2 and not kind.two_layers
            ),
            "machine.G is defined for the local form of the Triway only: it must be 0": (
                self.machine.G and not (local and kind.implications)
            ),
            "data.rooms must be at least 1, because `rooms` is a source": (
                "rooms" in self.data.sources and not self.data.rooms
            ),
            "objects.epochs must be at least 1: the objective `relations` trains no objects": (
                self.objective.name == "relations" and not self.objects.epochs
            ),
        } | {
            f"{name} is defined for the local form only: it must be 0": value and not local
            for name, value in local_only.items()
        }
        if broken := next((message for message, breaks in rules.items() if breaks), None):
            raise ValueError(broken)
        return self

    @property
    def digest(self) -> str:
        """The sha256 of the configuration. A checkpoint needs a configuration of equal sha256."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def first_error(error: ValidationError) -> str:
    """Return the path and the message of the first invalid entry."""
    first = error.errors()[0]
    path = ".".join(str(part) for part in first["loc"]) or "the file"
    return f"{path}: {first['msg']}"
