"""Example scenes of a model, for the visual page. The manifest contains them."""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, Field, field_serializer, field_validator

from app.registry.fields import Frozen, Many, to_json
from scene_client.schemas import Label, SceneRequest

MAX_EXAMPLES: Final = 8
MAX_WORD: Final = 100
MAX_EXAMPLES_BYTES: Final = 32_768
"""Maximum size of all examples of a model as JSON, in bytes."""
_FIELDS: Final = frozenset({"objects", "relations", "room_type", "frame_id", "viewpoint"})


def _compact(value: Any) -> Any:
    """Remove absent and empty fields, and make each label an object."""
    if isinstance(value, dict):
        return {name: _compact(part) for name, part in value.items() if part not in (None, [])}
    if isinstance(value, list):
        return [{"label": part} if isinstance(part, str) else _compact(part) for part in value]
    return value


class Example(Frozen):
    """An example scene, as the fields of a request to the service, and its name."""

    name: Label
    scene: Annotated[SceneRequest, BeforeValidator(_compact)]

    @field_validator("scene")
    @classmethod
    def _has_no_other_field(cls, scene: SceneRequest) -> SceneRequest:
        if extra := sorted(scene.model_fields_set - _FIELDS):
            raise ValueError(f"an example must not have the field {extra[0]!r}")
        return scene

    @field_serializer("scene")
    def _without_defaults(self, scene: SceneRequest) -> dict[str, Any]:
        return scene.model_dump(mode="json", exclude_defaults=True)

    def request(self) -> dict[str, Any]:
        """Return the scene as the fields of a request, without absent fields."""
        return self._without_defaults(self.scene)


def _are_small(examples: tuple[Example, ...]) -> tuple[Example, ...]:
    size = len(to_json([example.model_dump(mode="json") for example in examples]).encode())
    if size > MAX_EXAMPLES_BYTES:
        raise ValueError(f"the examples have {size} bytes, more than {MAX_EXAMPLES_BYTES}")
    return examples


Examples = Annotated[Many[Example], Field(max_length=MAX_EXAMPLES), AfterValidator(_are_small)]
"""The examples of a model: at most `MAX_EXAMPLES`, of at most `MAX_EXAMPLES_BYTES` together."""
