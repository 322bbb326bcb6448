"""Base class and field types of stored JSON, and of groups of stored tensors."""

import json
from abc import abstractmethod
from collections.abc import Collection
from dataclasses import dataclass, fields
from datetime import UTC
from typing import Annotated, Any, ClassVar, TypeVar

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

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


def require_printable(value: str) -> str:
    """Return a text on one line without control characters. Raise ValueError for another text."""
    if not value.isprintable():
        raise ValueError("must be one line without control characters")
    return value


Text = Annotated[str, StringConstraints(min_length=1), AfterValidator(require_printable)]
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
    of each size: `Annotated[Table, "V", 3]`. The name of a stored tensor is `prefix` and the name
    of the field. The fields in `integers` have integers, all others
    floating-point numbers.
    """

    prefix: ClassVar[str]
    integers: ClassVar[Collection[str]]

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Return a mapping of tensor names in an artifact to the arrays."""
        return {self.tensor(field.name): getattr(self, field.name) for field in fields(self)}

    @classmethod
    def tensor(cls, field: str) -> str:
        """Return the name of the tensor of a field."""
        return f"{cls.prefix}{field}"

    @abstractmethod
    def check(self, A: int, V: int, C: int) -> None:
        """Check the values for a model with A relations, V classes and C room types.

        Raises:
            ValueError: a value is not possible.
        """

    def require(self, condition: object, complaint: str) -> None:
        """Raise ValueError with the complaint if the condition is false."""
        if not condition:
            subject = self.prefix.removesuffix("s.")
            raise ValueError(f"the {subject} tensors are invalid: {complaint}")

    def require_keys(self, name: str, limit: int) -> None:
        """Require that a field has ascending numbers from 0 to ``limit`` - 1."""
        keys = getattr(self, name)
        is_right = ((keys >= 0) & (keys < limit)).all() and (keys[1:] > keys[:-1]).all()
        self.require(is_right, f"the keys in {name} must be ascending, from 0 to {limit - 1}")
