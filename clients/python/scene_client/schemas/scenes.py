"""The HTTP contract of `/scenes`: scenes from files of detectors, tools and simulators."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from scene_client.schemas.answers import Reply
from scene_client.schemas.requests import Request, plain_text


class ScenesRequest(Request):
    """A file in one of the formats of docs/clients.md: either its `text` or its bytes."""

    text: str | None = None
    """the content of the file, if it is text"""
    base64: str | None = None
    """the bytes of the file in Base64 (RFC 4648), in place of `text`"""
    name: Annotated[str, Field(min_length=1, max_length=255), AfterValidator(plain_text)] | None = (
        None
    )
    """name of the file. The content decides the format, so the name may be left out"""
    label_map: Annotated[str | None, Field(max_length=65536)] = None
    """labels of numeric class ids: `coco80`, `coco91`, or the content of a file with the labels"""

    @model_validator(mode="after")
    def _has_content(self) -> Self:
        if (self.text is None) == (self.base64 is None):
            raise PydanticCustomError("content", "must have either `text` or `base64`")
        return self


class FileScene(Reply):
    """One scene of a file."""

    name: str
    """line of a file with one scene a line, id of an image or task, number of a frame, or name of a
    room. The name of an only scene may be empty"""
    scene: dict[str, Any]
    """the fields of a request, for any question"""


class FileNote(Reply):
    """A value of a file that is not part of a scene, with the reason."""

    scene: int | None
    """index of the scene in `scenes`, or null for the whole file"""
    detection: int | None
    """index of the detection in its scene, or null for the whole scene"""
    reason: str
    """stable code of the reason"""
    detail: str
    """the reason in words"""


class ScenesAnswer(Reply):
    """The scenes of a file in their order, and notes about the parts that they leave out."""

    request_id: str
    scenes: list[FileScene]
    notes: list[FileNote]
