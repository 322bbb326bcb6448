"""Base class and field types of stored JSON, and of groups of stored tensors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from typing import Annotated, Any, ClassVar, Self, TypeVar

from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    StringConstraints,
)

from app.registry.errors import ArtifactError

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, StringConstraints(min_length=1)]
Count = Annotated[int, Field(ge=0)]

ItemT = TypeVar("ItemT")
Many = Annotated[tuple[ItemT, ...], FailFast()]
"""A tuple whose validation stops at the first invalid item. Otherwise, errors for a million invalid
items would take gigabytes of memory."""


def _in_utc(moment: datetime) -> datetime:
    try:
        return moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("the time must be in the years 1 to 9999 in UTC") from None


Timestamp = Annotated[AwareDatetime, AfterValidator(_in_utc)]


def to_json(value: Any) -> str:
    """Return a value as one line of JSON. Raise ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


class Frozen(BaseModel):
    """Base class of immutable pydantic models. They refuse unknown fields, NaN and infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class TensorGroup:
    """Base class of groups of arrays that an artifact stores beside the tensors of the machine.

    A subclass is a dataclass whose fields are the arrays. The names of the stored tensors begin
    with `prefix`.
    """

    prefix: ClassVar[str]

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Return a mapping of tensor names in an artifact to the arrays."""
        return {f"{self.prefix}{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def read(
        cls, tensors: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]
    ) -> Self:
        """Build the group from stored tensors. ``shapes`` has the required shape of each field.

        Raises:
            ArtifactError: `wrong_shape` if a tensor is missing, unexpected or of a wrong shape.
        """
        for name in sorted(tensors.keys() | {f"{cls.prefix}{name}" for name in shapes}):
            required = shapes.get(name.removeprefix(cls.prefix))
            shape = tensors[name].shape if name in tensors else None
            if shape != required:
                raise ArtifactError(
                    "wrong_shape",
                    f"tensor '{name}' has the shape {shape}, but the shape must be {required} "
                    "(None means that the tensor does not exist)",
                )
        return cls(**{name: tensors[f"{cls.prefix}{name}"] for name in shapes})
