"""The description of a model, as training writes it: metadata without weights and files."""

from collections.abc import Sequence
from typing import Annotated, Any, Final, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    JsonValue,
    PrivateAttr,
    field_serializer,
    field_validator,
    model_validator,
)

from app.model.calibration import PAIR_CALIBRATIONS, Calibration
from app.model.fields import (
    Count,
    Frozen,
    Many,
    Sha256,
    Text,
    Timestamp,
    require_printable,
    to_json,
)
from app.registry.references import ModelName, Version
from app.scene.spatial_relations import CANONICAL
from app.scene.vocabulary import ObjectClass, Vocabulary
from scene_client.schemas import MAX_LABEL, Label, SceneRequest


class VocabularyEntry(Frozen):
    """The object classes, relations, room types and profiles of a model, by their indices.

    A profile is a data source whose base rates a request can choose.
    """

    objects: Many[ObjectClass]
    relations: Many[str] = CANONICAL
    room_types: Many[Text] = ()
    room_aliases: dict[Text, Many[Text]] = Field(default_factory=dict)
    profiles: Many[Text] = ()
    _words: Vocabulary = PrivateAttr()

    @model_validator(mode="after")
    def _check_vocabulary(self) -> Self:
        if self.relations != CANONICAL[: len(self.relations)]:
            raise ValueError(f"relations must be the first of {CANONICAL}, in the same order")
        self._words = Vocabulary(self.objects, self.room_types, self.room_aliases)
        names = [name for entry in self.objects for name in (entry.label, *entry.aliases)]
        names += [*self.room_types, *(one for more in self.room_aliases.values() for one in more)]
        if any(len(name) > MAX_LABEL for name in names):
            raise ValueError(f"a name has more than {MAX_LABEL} characters")
        return self

    @classmethod
    def of(
        cls, vocabulary: Vocabulary, relations: int = len(CANONICAL), profiles: Sequence[str] = ()
    ) -> Self:
        """Return the manifest entry of a vocabulary for a machine with A = ``relations``."""
        words = {name: getattr(vocabulary, name) for name in ("objects", "room_types")}
        words |= {"relations": CANONICAL[:relations], "profiles": profiles}
        return cls.model_validate(words | {"room_aliases": vocabulary.room_aliases})

    def vocabulary(self) -> Vocabulary:
        """Return the vocabulary."""
        return self._words


class DataSource(Frozen):
    """One source of training scenes."""

    source: Text
    scenes: Count
    digest: Sha256  # of the data
    terms: Text
    research_only: bool
    share: float | None = None  # of the weight of all scenes that teach objects; None: not recorded
    written: bool = False  # True: the scenes are drawn from written places; False: they were seen


class Metric(Frozen):
    """One measured figure of the model's quality, with its 95 % confidence interval."""

    task: Text  # such as "T2 missing"
    source: Text  # of the test scenes
    metric: Text
    value: float
    low: float
    high: float
    n: Annotated[int, Field(ge=1)]  # measured cases, such as scenes or removed objects


MAX_EXAMPLES: Final = 8
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
    def _check_fields_of_scene(cls, scene: SceneRequest) -> SceneRequest:
        if extra := sorted(scene.model_fields_set - _FIELDS):
            raise ValueError(f"an example must not have the field {extra[0]!r}")
        return scene

    @field_serializer("scene")
    def _without_defaults(self, scene: SceneRequest) -> dict[str, Any]:
        return scene.model_dump(mode="json", exclude_defaults=True)

    def request(self) -> dict[str, Any]:
        """Return the scene as the fields of a request, without absent fields."""
        return self._without_defaults(self.scene)


def _check_size(examples: tuple[Example, ...]) -> tuple[Example, ...]:
    size = len(to_json([example.model_dump(mode="json") for example in examples]).encode())
    if size > MAX_EXAMPLES_BYTES:
        raise ValueError(f"the examples have {size} bytes, more than {MAX_EXAMPLES_BYTES}")
    return examples


Examples = Annotated[Many[Example], Field(max_length=MAX_EXAMPLES), AfterValidator(_check_size)]
"""The examples of a model: at most `MAX_EXAMPLES`, of at most `MAX_EXAMPLES_BYTES` together."""


class Description(Frozen):
    """The description of a model: its manifest without the entries about files."""

    name: ModelName
    version: Version
    created: Timestamp  # UTC
    spec: dict[str, JsonValue]  # `MachineSpec.to_dict`
    vocabulary: VocabularyEntry
    calibration: Calibration
    training: dict[str, JsonValue]  # configuration and seed, without a fixed schema
    data: Many[DataSource]
    metrics: Many[Metric]  # measured on scenes that training did not use
    terms: Text  # of use of the weights
    libraries: dict[str, str]  # name and version of each library used in training
    examples: Examples = ()  # for the scene editor

    @field_validator("spec", "training", "libraries", "terms")
    @classmethod
    def _check_json(cls, value: JsonValue) -> JsonValue:
        # pydantic accepts NaN in JSON without a schema. It cannot be written.
        to_json(value)
        nodes: list[Any] = [value]
        for node in nodes:
            if isinstance(node, str):
                require_printable(node)
            elif isinstance(node, dict | list):
                nodes += [*node, *node.values()] if isinstance(node, dict) else node
        return value

    @model_validator(mode="after")
    def _check_spec(self) -> Self:
        """Check that the sizes in the spec are the lengths of the lists in the other fields."""
        words = self.vocabulary
        for name, what, length in (
            ("V", "vocabulary objects", len(words.objects)),
            ("A", "vocabulary relations", len(words.relations)),
            ("profiles", "vocabulary profiles", len(words.profiles)),
            *(
                ("A", f"entries of calibration.{name}", len(getattr(self.calibration, name)))
                for name in (*PAIR_CALIBRATIONS, "at")
            ),
        ):
            if self.spec.get(name, 0) != length:
                given = f"{name} = {self.spec.get(name)}"
                raise ValueError(f"the description has {length} {what}, but the spec has {given}")
        rooms, types = self.spec.get("C", 0), len(words.room_types)
        if rooms not in (0, types):
            raise ValueError(f"the vocabulary has {types} room types, but the spec has C = {rooms}")
        for name in ("rare_rooms", "written_rooms"):
            if any(t >= rooms for t in getattr(self.calibration, name)):
                raise ValueError(f"calibration.{name} must be below C = {rooms}")
        return self

    @property
    def variant(self) -> str:
        """Name of the machine's variant, such as "triway"."""
        return str(self.spec.get("variant"))
