"""Base class and field types of stored JSON, and of groups of stored tensors."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from datetime import UTC
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    StringConstraints,
    ValidationError,
)

from app.registry.errors import ArtifactError

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, StringConstraints(min_length=1)]
Count = Annotated[int, Field(ge=0)]

ItemT = TypeVar("ItemT")
Many = Annotated[tuple[ItemT, ...], FailFast()]
"""A tuple whose validation stops at the first invalid item. Otherwise, errors for a million invalid
items would take gigabytes of memory."""


Timestamp = Annotated[AwareDatetime, AfterValidator(lambda moment: moment.astimezone(UTC))]


def to_json(value: Any) -> str:
    """Return a value as one line of JSON. Raise ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def first_error(error: ValidationError) -> str:
    """Return the location and message of the first validation error, without the invalid value."""
    detail = error.errors(include_url=False, include_input=False, include_context=False)[0]
    return ": ".join(filter(None, (".".join(map(str, detail["loc"])), detail["msg"])))


class Frozen(BaseModel):
    """Base class of immutable pydantic models. They refuse unknown fields, NaN and infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class TensorGroup:
    """Base class of groups of arrays that an artifact stores beside the tensors of the machine.

    A subclass is a dataclass of arrays. The annotation of a field contains the name or the number
    of each size: `Annotated[Table, "V", 3]`. The names of the stored tensors begin with `prefix`.
    The fields in `integers` have integers, all others floating-point numbers.
    """

    prefix: ClassVar[str]
    integers: ClassVar[Collection[str]]

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Return a mapping of tensor names in an artifact to the arrays."""
        return {f"{self.prefix}{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def read(cls, tensors: Mapping[str, NDArray[Any]], **sizes: int) -> Self:
        """Build the group from stored tensors.

        Args:
            sizes: named sizes of the model. The first field with another size defines it.

        Raises:
            ArtifactError: `wrong_shape` if a tensor is missing, unexpected or of a wrong shape;
                `invalid_tensor` if a tensor has a wrong dtype.
        """
        shapes = {}
        for name, hint in get_type_hints(cls, include_extras=True).items():
            if axes := getattr(hint, "__metadata__", ()):
                actual = np.shape(tensors.get(f"{cls.prefix}{name}", ()))
                sizes = dict(zip(axes, actual, strict=False)) | sizes
                shapes[name] = tuple(
                    sizes.get(axis, 0) if isinstance(axis, str) else axis for axis in axes
                )
        for name in sorted(tensors.keys() | {f"{cls.prefix}{name}" for name in shapes}):
            required = shapes.get(name.removeprefix(cls.prefix))
            shape = tensors[name].shape if name in tensors else None
            if shape != required:
                reason = f"tensor '{name}' has the shape {shape}, not {required} (None: no tensor)"
                raise ArtifactError("wrong_shape", reason)
        group = cls(**{name: tensors[f"{cls.prefix}{name}"] for name in shapes})
        for name in shapes:
            kind = np.integer if name in cls.integers else np.floating
            is_right = np.issubdtype(getattr(group, name).dtype, kind)
            group.require(is_right, f"{name} must have a dtype of {kind.__name__}")
        return group

    def require(self, condition: object, complaint: str) -> None:
        """Raise ArtifactError `invalid_tensor` with the complaint if the condition is false."""
        if not condition:
            subject = self.prefix.removesuffix("s.")
            raise ArtifactError("invalid_tensor", f"the {subject} tensors are invalid: {complaint}")

    def require_keys(self, name: str, limit: int) -> None:
        """Require that a field has ascending numbers from 0 to ``limit`` - 1."""
        keys = getattr(self, name)
        is_right = ((keys >= 0) & (keys < limit)).all() and (keys[1:] > keys[:-1]).all()
        self.require(is_right, f"the keys in {name} must be ascending, from 0 to {limit - 1}")
