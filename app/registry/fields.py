"""Base class and field types of stored JSON, and the check of stored tensors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, TypeVar

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


def require_shapes(
    tensors: Mapping[str, NDArray[Any]], prefix: str, shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Check the names and shapes of a group of tensors.

    Args:
        tensors: all tensors whose names begin with the prefix.
        shapes: maps each name without the prefix to the required shape.

    Raises:
        ArtifactError: `wrong_shape` if a tensor is missing, unexpected or of a wrong shape.
    """
    for name in sorted(tensors.keys() | {f"{prefix}{name}" for name in shapes}):
        shape = shapes.get(name.removeprefix(prefix))
        found = tensors[name].shape if name in tensors else None
        if found != shape:
            raise ArtifactError(
                "wrong_shape",
                f"tensor '{name}' has the shape {found}, but the shape must be {shape} (None means "
                "that the tensor does not exist)",
            )
