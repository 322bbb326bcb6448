"""Annotated scenes, the common result of all readers of scene files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from app.scene import RELATIONS
from scene_client.frames import Conventions
from scene_client.schemas import MAX_LABEL
from scene_client.untrusted import printable

Box2d = tuple[float, float, float, float]

MAX_COUNT: Final = 1_000_000
MAX_PROBLEM: Final = 500  # maximum length of the text of a `DatasetError`, in characters


class DatasetError(ValueError):
    """A data file cannot be read or has invalid content at a position, such as ``line 3``.

    The position `where` is "" if the problem concerns the whole file.
    """

    def __init__(self, path: Path, where: str, problem: str) -> None:
        problem = printable(problem)
        if len(problem) > MAX_PROBLEM:  # the text can contain a value of several megabytes
            problem = problem[:MAX_PROBLEM] + "…"
        super().__init__(f"{path}, {where}: {problem}" if where else f"{path}: {problem}")
        self.path = path
        self.where = where
        self.problem = problem

    @classmethod
    def unreadable(cls, path: Path, error: Exception) -> DatasetError:
        """Return the error for a file that is missing or cannot be read."""
        if isinstance(error, FileNotFoundError):
            return cls(path, "", "no such file")
        return cls(path, "", f"cannot be read: {getattr(error, 'strerror', None) or error}")


MAX_LISTED: Final = 32
"""Maximum number of listed errors of a file. Further errors are only counted."""


class InvalidLinesError(DatasetError):
    """Lines of a file are invalid. `count` errors; `errors` has the first `MAX_LISTED` of them."""

    def __init__(self, path: Path, errors: Sequence[DatasetError], count: int) -> None:
        first = errors[0]
        more = f" (and {count - 1} more errors)" if count > 1 else ""
        super().__init__(path, first.where, first.problem + more)
        self.errors = tuple(errors[:MAX_LISTED])
        self.count = count


def _of_request(values: Any) -> Any:
    """Return the values of an object {x, y, z}, as in a request; other values as they are."""
    if isinstance(values, dict) and set(values) == {"x", "y", "z"}:
        return [values[axis] for axis in "xyz"]
    return values


def _ordered(box: Box2d) -> Box2d:
    if box[0] > box[2] or box[1] > box[3]:
        raise ValueError(f"must be (xmin, ymin, xmax, ymax), not {box}")
    return box


def _plain(label: str) -> str:
    if not label.isprintable():
        raise ValueError("must be one line without control characters")
    return label


Text = Annotated[str, Field(pattern=r"\S")]  # a text that is not blank
Label = Annotated[Text, Field(max_length=MAX_LABEL), AfterValidator(_plain)]
"""A label or a room type, which may become a name in a manifest."""
Id = Annotated[str, BeforeValidator(lambda x: str(x) if type(x) is int else x)]
"""An id: a text, or an integer, which is converted to text."""
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Length = Annotated[Number, Field(ge=0)]


@pydantic_dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class AnnotatedObject:
    """One annotated object. None means that a value is unknown."""

    id: Id  # distinct within the scene
    label: Label
    # Centre (x, y, z) in metres.
    position: Annotated[tuple[Number, Number, Number], BeforeValidator(_of_request)] | None = None
    # Extents before rotation by the yaw, (x, y, z) in metres.
    size: Annotated[tuple[Length, Length, Length], BeforeValidator(_of_request)] | None = None
    yaw: Number = 0.0  # rotation about the z axis in radians
    supported_by: Id | None = None  # id of the supporting object
    # (xmin, ymin, xmax, ymax) in the image, with y downwards.
    box2d: Annotated[tuple[Number, Number, Number, Number], AfterValidator(_ordered)] | None = None
    # Number of instances that this entry represents.
    count: Annotated[int, Field(strict=True, ge=1, le=MAX_COUNT)] = 1


@dataclass(frozen=True, slots=True)
class AnnotatedScene:
    """One annotated scene. Relations are triples (subject index, relation, object index)."""

    scene_id: str  # distinct within the data source
    source: str
    group: str  # name of a group of near-duplicate scenes, such as frames of one place
    room_type: str | None  # as in the data set; None means unknown
    objects: tuple[AnnotatedObject, ...]
    relations: tuple[tuple[int, str, int], ...] | None = None  # None: not annotated
    # True if positions are in viewer axes. Otherwise a viewpoint must be chosen for left and front.
    viewer_frame: bool = False
    false_relations: tuple[tuple[int, str, int], ...] = ()  # marked as false by an annotator
    # Indices of objects with a listed support, also by other relations such as "attached to".
    supported: tuple[int, ...] = ()
    # True for a recorded scene that a person has confirmed. The digest of a data source does not
    # depend on it.
    confirmed: bool = field(default=False, repr=False)
    # The conventions that the file declares. The poses of the objects are in metres, with z up.
    conventions: Conventions = field(default=Conventions(), repr=False)

    def __post_init__(self) -> None:
        """Check that ids are distinct, and that supports and relations name objects."""
        ids = {thing.id for thing in self.objects}
        if len(ids) < len(self.objects):
            raise ValueError(f"scene {self.scene_id!r} has two objects with the same id")
        for thing in self.objects:
            if thing.supported_by is not None and thing.supported_by not in ids:
                raise ValueError(
                    f"supported_by of {thing.id!r} is {thing.supported_by!r}, which is no object "
                    "of the scene"
                )
        size = len(self.objects)
        for subject, relation, anchor in (*(self.relations or ()), *self.false_relations):
            if relation not in RELATIONS:
                raise ValueError(f"unknown relation {relation!r}")
            if unknown := [end for end in (subject, anchor) if not 0 <= end < size]:
                raise ValueError(
                    f"a relation has object index {unknown[0]}, but the scene has {size} objects"
                )

    def only(self, kept: Sequence[int]) -> AnnotatedScene:
        """Return the scene with the objects at the ascending indices `kept` and their relations."""
        index_of = {old: new for new, old in enumerate(kept)}
        ids = {self.objects[k].id for k in kept}

        def among(triples: Sequence[tuple[int, str, int]]) -> tuple[tuple[int, str, int], ...]:
            """Return the triples between two kept objects, with their new indices."""
            return tuple(
                (index_of[i], name, index_of[j])
                for i, name, j in triples
                if i in index_of and j in index_of
            )

        return replace(
            self,
            objects=tuple(
                thing
                if thing.supported_by is None or thing.supported_by in ids
                else replace(thing, supported_by=None)
                for thing in (self.objects[k] for k in kept)
            ),
            relations=None if self.relations is None else among(self.relations),
            false_relations=among(self.false_relations),
            supported=tuple(index_of[i] for i in self.supported if i in index_of),
        )


def digest_of(scenes: Sequence[AnnotatedScene]) -> str:
    """Return the sha256 of the contents of the scenes. It does not depend on the file format."""
    return hashlib.sha256("".join(map(repr, scenes)).encode()).hexdigest()
