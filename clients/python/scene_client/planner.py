"""Tools for planners with a language model. Each tool asks one question and answers in sentences.

`schemas` describes the tools to a language model, and `call` runs a tool that the model has called.
The MCP server (`mcp_server`) lists the same tools. docs/planners.md describes them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

from pydantic import BeforeValidator, Field, WithJsonSchema
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import PydanticCustomError, core_schema

from scene_client import phrases, sentences
from scene_client.calls import validated
from scene_client.errors import ClientError, InvalidRequestError
from scene_client.schemas import MAX_LABEL, Answer, Relation, Request
from scene_client.schemas.missing import Anchor
from scene_client.schemas.requests import Detection, Label, SceneObject, SomeObjects
from scene_client.schemas.where import Searched
from scene_client.sync import Client
from scene_client.untrusted import printable, printable_answer, shortened

AnswerT = TypeVar("AnswerT", bound=Answer)

Vendor = Literal["openai", "anthropic", "langchain"]

MOST_TEXT: Final = 10_000
"""Maximum length of an answer or an error in characters, for the context of the language model."""
MOST_ENTRIES: Final = 256
"""Maximum number of entries in each list of the arguments."""
_LONGEST_NAME: Final = 300  # characters of a text in an answer of the service
_LONGEST_PHRASE: Final = 3 * MAX_LABEL
_SAMPLES: Final = 20  # rooms from which `imagine_room` counts


class ToolError(ClientError):
    """A tool has no answer. The text is one sentence for the language model, with the remedy."""


# ---------------------------------------------------------------------------------- arguments

_TEXTS: Final = {"type": "array", "items": {"type": "string"}}
_TRIPLE: Final = {"type": "array", "items": {"type": "number"}}
# The schema is smaller than that of a detection, so a language model fills it in correctly.
_OBJECTS: Final = {
    "type": "array",
    "items": {
        "anyOf": [
            {"type": "string"},
            {
                "type": "object",
                "properties": {
                    "label": {"type": "string"},
                    "position": {
                        **_TRIPLE,
                        "description": "centre in metres: [ahead, left, up] of the robot",
                    },
                    "size": {**_TRIPLE, "description": "extents in metres, along the same axes"},
                },
                "required": ["label"],
            },
        ]
    },
}
_HOME: Final = {"type": "object", "additionalProperties": _TEXTS}


def _as_relation(value: Any) -> Any:
    """Return the fields of a relation; a text of a place that the service does not use stays."""
    is_used = isinstance(value, str) and not phrases.is_unused(_short(value))
    return phrases.relation(value) if is_used else value


def _spoken(read: Callable[[str], dict[str, Any]]) -> BeforeValidator:
    return BeforeValidator(lambda value: read(_short(value)) if isinstance(value, str) else value)


def _short(phrase: str) -> str:
    """Return a phrase. A longer one than two labels and a relation is refused unread."""
    if len(phrase) > _LONGEST_PHRASE:
        rule = f"must have at most {_LONGEST_PHRASE} characters"
        raise PydanticCustomError("phrase", "{rule}", {"rule": rule})
    return phrase


Objects = Annotated[SomeObjects, WithJsonSchema(_OBJECTS)]
_Few = Field(max_length=MOST_ENTRIES)
Labels = Annotated[list[Label], _Few, WithJsonSchema(_TEXTS)]
Stated = Annotated[Relation | Label, BeforeValidator(_as_relation)]
Relations = Annotated[list[Stated], _Few, WithJsonSchema(_TEXTS)]
Place = Annotated[Anchor, _spoken(phrases.place), WithJsonSchema({"type": "string"})]
Home = Annotated[
    dict[Label, Annotated[list[SceneObject], _Few]],
    Field(min_length=1, max_length=32),
    WithJsonSchema(_HOME),
]
Places = Annotated[list[Annotated[Searched, _spoken(phrases.search)]], _Few, WithJsonSchema(_TEXTS)]


class _Schema(GenerateJsonSchema):
    """Schemas without titles and defaults. An optional argument has the schema of its value."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def str_schema(self, schema: core_schema.StringSchema) -> JsonSchemaValue:
        return {"type": "string"}


def _plain(answer: AnswerT) -> AnswerT:
    """Return an answer whose names are short single lines: other texts could pose as a prompt."""
    return printable_answer(answer, _LONGEST_NAME)


class Tool(Request):
    """Base class of the tools. The fields are the arguments, the docstring is the description."""

    name: ClassVar[str]

    @classmethod
    def description(cls) -> str:
        """Return what the tool does, for the language model."""
        return " ".join((cls.__doc__ or "").split())

    @classmethod
    def parameters(cls) -> dict[str, Any]:
        """Return the JSON schema of the arguments."""
        schema = cls.model_json_schema(schema_generator=_Schema)
        return {name: schema[name] for name in ("type", "properties", "required") if name in schema}

    def answer(self, client: Client) -> str:
        """Ask the client, and return the answer in sentences."""
        raise NotImplementedError

    def fields(self) -> dict[str, Any]:
        """Return the arguments as fields of a request. Unknown words are read by their meaning."""
        return self.model_dump(exclude_none=True) | {"unknown_labels": "by-meaning"}


class _SceneTool(Tool):
    objects: Objects
    """the objects of one room, in plain words; with positions only if they are measured"""
    relations: Relations | None = None
    """known relations of these objects, such as "lamp on desk", as texts; unused with positions"""
    room_type: Label | None = None
    """kind of the room, only if it is certain"""

    def fields(self) -> dict[str, Any]:
        """Return the arguments as fields of a request, without the relations of `unused`."""
        fields = super().fields()
        fields.pop("relations", None)
        if used := [one for one in self.relations or () if self._is_used(one)]:
            fields["relations"] = used
        return fields

    def unused(self) -> list[str]:
        """Return the stated relations that the request does not have, in words."""
        return [
            one if isinstance(one, str) else f"{one.subject} {one.relation} {one.object}"
            for one in self.relations or ()
            if not self._is_used(one)
        ]

    def _is_used(self, stated: Relation | str) -> bool:
        # The service derives relations from positions only if none are stated.
        placed = any(isinstance(one, Detection) and one.position for one in self.objects)
        return isinstance(stated, Relation) and not placed


class FindOutOfPlace(_SceneTool):
    """Find the objects of a room that do not belong there, or that are in a wrong place. Use it
    for "is anything odd here?", and before tidying up."""

    name: ClassVar[str] = "find_out_of_place"

    def answer(self, client: Client) -> str:
        """Return the objects that do not belong, and those in wrong places."""
        found = _plain(client.outliers(**self.fields()))
        return sentences.text(found, sentences.out_of_place(found), unused=self.unused())


class SuggestMissing(_SceneTool):
    """Suggest the objects that a room probably has or lacks beside the listed ones, and where each
    would be. Use it for "what is missing?", "what else is there?" and "what belongs on a desk?"."""

    name: ClassVar[str] = "suggest_missing"

    at: Place | None = None
    """ask only about this place, such as "on-top desk"; the object must be in `objects`"""
    only: Labels | None = None
    """ask only about these things, such as ["kettle"] to learn if there is a kettle"""

    def answer(self, client: Client) -> str:
        """Return the likely missing objects with their places."""
        fields = self.fields()
        if "only" in fields:
            fields["candidates"] = fields.pop("only")
        found = _plain(client.missing(**fields, top_k=8))
        said = [*sentences.missing(found, only=self.only is not None)]
        labels = {one if isinstance(one, str) else one.label for one in self.objects}
        if listed := [name for name in self.only or () if name in labels]:
            said.insert(0, f"Already listed: {', '.join(listed)}.")
        return sentences.text(found, said, unused=self.unused())


class LocateObject(Tool):
    """Find where a thing probably is, or usually lies, in a home whose rooms are known. Use it for
    "where are my keys?", to search for a thing, and to choose a place for a thing."""

    name: ClassVar[str] = "locate_object"

    thing: Label
    """the wanted thing in plain words, such as "mug" or "can opener", without details"""
    rooms: Home
    """the rooms of the home with their objects, such as {"kitchen": ["fridge", "counter"]}"""
    searched: Places | None = None
    """places already searched without success: "bathroom", or "kitchen: counter" for one object"""

    def answer(self, client: Client) -> str:
        """Return the likely rooms and places of the thing."""
        fields = self.fields() | {"label": self.thing}
        del fields["thing"]
        # A stated room type that is unknown is listed in the answer; a mere id is not.
        fields["rooms"] = [
            {"id": name, "room_type": name, "objects": objects}
            for name, objects in fields["rooms"].items()
        ]
        found, labels = _plain(client.where(**fields)), phrases.labels_in(fields["rooms"])
        said = sentences.where(found, labels, self.searched or ())
        return sentences.text(found, said, rooms=self.rooms)


class IdentifyRoom(Tool):
    """Tell which kind of room has these objects. For a single object, tell in which kinds of rooms
    it usually is. Use it for "which room is this?" and "in which room do people keep scissors?"."""

    name: ClassVar[str] = "identify_room"

    objects: Labels
    """the objects of one room in plain words, or one object"""
    candidates: Labels | None = None
    """the possible rooms, such as ["kitchen", "bathroom"]; default: all kinds of rooms"""

    def answer(self, client: Client) -> str:
        """Return the likely room types."""
        found = _plain(client.rooms(**self.fields()))
        return sentences.text(found, sentences.rooms(found, self.objects))


class RelateObjects(_SceneTool):
    """Tell how the objects of a room probably stand to each other: what is on, in, under or left of
    what. Use it for "where in the room is the book?" and to check relations."""

    name: ClassVar[str] = "relate_objects"

    def answer(self, client: Client) -> str:
        """Return the likely relations, and those that are unusual."""
        fields = self.fields() | {"top_k": 256, "min_probability": sentences.MENTIONED}
        found = _plain(client.relations(**fields))
        return sentences.text(found, sentences.relations(found), unused=self.unused())


class ImagineRoom(Tool):
    """Imagine a typical room of a kind: which objects it has, and where they stand. Use it for
    "what does a dentist's room look like?"."""

    name: ClassVar[str] = "imagine_room"

    room_type: Label | None = None
    """kind of the room in plain words: "kitchen", "dental office" and so on"""
    objects: Labels | None = None
    """objects that the room must have, if its kind is unknown"""

    def answer(self, client: Client) -> str:
        """Return the commonest objects and relations of sampled rooms."""
        if self.room_type is None and not self.objects:
            raise InvalidRequestError.about("give `room_type`, or else `objects`")
        # An object that is rare in such rooms would change what is usual there.
        unused = self.objects or [] if self.room_type else []
        fields = {"objects": [], **self.fields()} | ({"objects": []} if unused else {})
        # The same arguments give the same answer, so a planner can rely on it.
        found = _plain(client.generate(**fields, count=_SAMPLES, seed=0))
        given = {*(self.objects or ()), *filter(None, [self.room_type])}
        return sentences.text(found, sentences.imagined(found, given), unused=unused)


TOOLS: Final[dict[str, type[Tool]]] = {
    tool.name: tool
    for tool in (
        FindOutOfPlace, SuggestMissing, LocateObject, IdentifyRoom, RelateObjects, ImagineRoom
    )
}  # fmt: skip


def schemas(vendor: Vendor) -> list[dict[str, Any]]:
    """Return the tools in the form of a vendor.

    Args:
        vendor: `openai` for tools of chat completions, `anthropic` for tools of the Messages API,
            `langchain` for JSON schemas with title and description, as `bind_tools` takes them.
    """
    forms: dict[Vendor, Callable[[type[Tool]], dict[str, Any]]] = {
        "openai": lambda tool: {
            "type": "function",
            "function": {
                "name": tool.name,
                "description": tool.description(),
                "parameters": tool.parameters(),
                # Strict functions would require all arguments.
                "strict": False,
            },
        },
        "anthropic": lambda tool: {
            "name": tool.name,
            "description": tool.description(),
            "input_schema": tool.parameters(),
        },
        "langchain": lambda tool: {
            "title": tool.name,
            "description": tool.description(),
            **tool.parameters(),
        },
    }
    return [forms[vendor](tool) for tool in TOOLS.values()]


def call(client: Client, name: str, arguments: Mapping[str, Any]) -> str:
    """Run a tool that a language model has called, and return the answer in sentences.

    Args:
        client: the client that asks the service, also an `OfflineClient`.
        name: name of the tool.
        arguments: arguments of the tool, as the schema describes them.

    Raises:
        ToolError: the tool has no answer. The text is for the language model.
    """
    try:
        if name not in TOOLS:
            problem = f"no tool {shortened(name, MAX_LABEL)}; the tools are {', '.join(TOOLS)}"
            raise InvalidRequestError.about(problem)
        answer = validated(TOOLS[name], dict(arguments)).answer(client)
        return shortened(printable(answer), MOST_TEXT)
    except ClientError as error:
        text = shortened(printable(sentences.failure(error)), MOST_TEXT)
        raise ToolError(text) from error
