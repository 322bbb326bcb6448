"""Names in a request: labels and room types outside the vocabulary, and references to objects.

The functions collect all errors of a request before they raise an exception. So a client can
correct all errors at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

from app.errors import (
    InvalidRequestError,
    LocatedError,
    Location,
    RequestError,
    UnknownLabelsError,
    some_of,
)
from app.scene.labels import label_key
from app.scene.nearest import spelt_alike
from app.scene.scene import SceneObject
from app.scene.vocabulary import Vocabulary, Word
from scene_client.schemas import (
    Detection,
    Mapped,
    RoomsRequest,
    SceneRequest,
    UnknownLabels,
    WhereRequest,
)
from scene_client.validation import MAX_ERRORS, PLAIN

MAX_SUGGESTED: Final = 32
"""Maximum number of unknown labels that the service maps or reads by meaning, per scene.

It also limits the errors with suggestions, per request.
"""
MAX_MAPPED: Final = 256
"""Maximum number of unknown labels that the service maps or reads by meaning, per request."""
# Rules for the spellings of a name that the vocabulary lists.
_SPELLINGS: Final = ("label", "alias", "phrase")
_SEARCHES: Final[dict[UnknownLabels, tuple[str, ...]]] = {
    "error": ("read", "nearest"),
    "ignore": ("read",),
    "nearest": ("read", "guess", "nearest"),
    "nearest-or-ignore": ("read", "guess"),
    "by-meaning": ("read", "guess", "meaning"),
}
"""Names of the methods of `Vocabulary` that search for a label, for each treatment."""


def objects_of(request: SceneRequest | WhereRequest) -> list[str | Detection]:
    """Return the objects of a request about a scene or a home."""
    if isinstance(request, WhereRequest):
        return [thing for room in request.rooms for thing in room.objects]
    return request.objects


def new_labels(
    request: SceneRequest | WhereRequest,
    objects: Sequence[str | Detection],
    vocabulary: Vocabulary,
) -> int:
    """Return how many labels of objects, candidates and rooms need a search, of up to 1 ms each.

    A label that is read by its meaning counts each time, and as `MAX_SUGGESTED` labels, because the
    model then needs predicted weights.
    """
    searches = _SEARCHES[request.unknown_labels]
    by_name = tuple(search for search in searches if search != "meaning")  # also of room types
    new = 0
    for entry in objects:
        if isinstance(entry, str):
            new += not vocabulary.remembers(entry, searches)
            continue
        new += not vocabulary.remembers(entry.label, searches)
        for other in entry.alternatives:
            new += not vocabulary.remembers(other.label, searches)
    is_room = isinstance(request, RoomsRequest)
    candidates: Sequence[str] = getattr(request, "candidates", None) or ()
    if isinstance(request, WhereRequest):
        candidates = [request.label]
        for room in request.rooms:
            # The id of a room may name its type.
            name, tried = room.room_type, by_name
            if name is None:
                name, tried = room.id, ("read",)
            new += not vocabulary.remembers(name, tried, is_room=True)
    if is_room:
        searches = by_name
    new += sum(not vocabulary.remembers(label, searches, is_room=is_room) for label in candidates)
    return new * (MAX_SUGGESTED if "meaning" in searches else 1)


@dataclass(slots=True)
class ErrorList:
    """The errors of a request found so far, by class of exception."""

    by_class: dict[type[RequestError], list[LocatedError]] = field(default_factory=dict)

    def add(
        self,
        kind: type[RequestError],
        location: Location,
        message: str,
        suggestions: Sequence[str] = (),
    ) -> None:
        """Add an error without raising it."""
        error = LocatedError(location, message, tuple(suggestions))
        self.by_class.setdefault(kind, []).append(error)

    @property
    def are_many(self) -> bool:
        """Whether an answer cannot list further errors."""
        return sum(map(len, self.by_class.values())) >= MAX_ERRORS

    def raise_any(self) -> None:
        """Raise an exception if the request has errors.

        Raises:
            RequestError: all errors of one class, the first class in `app.errors` with errors.
        """
        for kind in RequestError.__subclasses__() if self.by_class else ():
            if kind in self.by_class:
                raise kind(self.by_class[kind])


# id() of a vocabulary, label, and whether it is a room type. The id is unique, because the request
# keeps its models in memory.
_Key = tuple[int, str, bool]


@dataclass(slots=True)
class LookUps:
    """Searches for names similar to unknown labels. The scenes of a request share their limits."""

    suggestions: int = 0  # errors with suggestions or with a search for similar ids
    searched: set[_Key] = field(default_factory=set)  # for similar names
    guessed: set[_Key] = field(default_factory=set)  # for the nearest class


@dataclass(slots=True)
class Unknown:
    """The labels of one scene that the vocabulary does not list, and their treatment."""

    vocabulary: Vocabulary
    treatment: UnknownLabels  # the field `unknown_labels` of the request
    look_ups: LookUps  # shared by all scenes of the request
    ignored: list[str] = field(default_factory=list)  # objects, candidates and room type
    # The class for each (label, is a room type), also for aliases of candidates and room types.
    mapped: dict[tuple[str, bool], Mapped] = field(default_factory=dict)
    guessed: set[_Key] = field(default_factory=set)  # labels with a search for the nearest class
    # Words that are read by their meaning. Their classes follow those of the vocabulary.
    words: dict[str, Word] = field(default_factory=dict)

    def resolve(
        self, label: str, name: str, location: Location, errors: ErrorList, *, is_room: bool = False
    ) -> int | None:
        """Return the index of the class or room type that a label names or that replaces it.

        Each treatment accepts the syntax of detectors, such as "chair_12". An ignored label adds
        ``name``, the name of its object, to `ignored`. A refused label adds an error. The result is
        then None.
        """
        match = self.vocabulary.read(label, is_room=is_room)
        if match is None and self._may_guess(label, is_room=is_room):
            match = self.vocabulary.guess(label, is_room=is_room)
            if match is None and not is_room and (index := self._by_meaning(label)) is not None:
                return index
        # An answer without the room type is a good answer, so `nearest` ignores it too.
        is_ignored = self.treatment != "error" and (is_room or self.treatment != "nearest")
        if match is None and is_ignored:
            self.ignored.append(name)
        elif match is None:
            self.refuse(label, location, errors, is_room=is_room)
        # Answers name objects by id, but room types and candidates by their canonical names.
        elif match.rule not in (_SPELLINGS if location[0] == "objects" else ("label",)):
            names = self.vocabulary.room_types if is_room else self.vocabulary.labels
            self.mapped[label, is_room] = Mapped(
                label=label,
                class_=names[match.entry],
                similarity=match.similarity,
                rule=match.rule,  # type: ignore[arg-type]
            )
        return None if match is None else match.entry

    def resolve_all(
        self, labels: Sequence[str], field: str, errors: ErrorList, *, is_room: bool = False
    ) -> dict[int, list[str]]:
        """Return the different labels of each class or room type in a field of the request."""
        labels_of: dict[int, list[str]] = {}
        for position, label in enumerate(labels):
            index = self.resolve(label, label, (field, position), errors, is_room=is_room)
            if index is not None and label not in (spellings := labels_of.setdefault(index, [])):
                spellings.append(label)
            if errors.by_class and errors.are_many:
                break
        return labels_of

    def _by_meaning(self, label: str) -> int | None:
        """Return the class of the word that a label names, or None without a word vector."""
        if "meaning" not in _SEARCHES[self.treatment]:
            return None
        if (word := self.vocabulary.meaning(label)) is None:
            return None
        self.words.setdefault(word.name, word)
        self.mapped[label, False] = Mapped(
            label=label,
            class_=self.vocabulary.labels[word.nearest],
            similarity=word.similarity,
            rule="meaning",
        )
        return len(self.vocabulary) + list(self.words).index(word.name)

    def index(self, name: str) -> int | None:
        """Return the index of the class with this name, also of a word that the scene names."""
        index = self.vocabulary.index(name)
        if index is None and self.words and (word := self.vocabulary.meaning(name)) is not None:
            names = list(self.words)
            return len(self.vocabulary) + names.index(word.name) if word.name in names else None
        return index

    def _may_guess(self, label: str, *, is_room: bool) -> bool:
        """Return whether the service may search the class nearest to a label, and count it."""
        if "guess" not in _SEARCHES[self.treatment]:
            return False
        key = id(self.vocabulary), label, is_room
        limits = ((self.guessed, MAX_SUGGESTED), (self.look_ups.guessed, MAX_MAPPED))
        if any(key not in guessed and len(guessed) >= most for guessed, most in limits):
            return False
        for guessed, _ in limits:
            guessed.add(key)
        return True

    def refuse(self, label: str, location: Location, errors: ErrorList, *, is_room: bool) -> None:
        """Add the error of an unknown label, with similar names."""
        names = self.vocabulary.room_types if is_room else self.vocabulary.labels
        message = "the model does not know this label"
        if not is_room and self.vocabulary.room_index(label) is not None:
            message += "; it is a room type: send it as `room_type`"
        if is_room:
            message = "this model does not have room types"
            if names:
                message = f"the model does not know this room type; it knows {some_of(names)}"
        key = id(self.vocabulary), label, is_room
        if self.treatment == "nearest" and key not in self.guessed:
            message += (
                f"; the service maps at most {MAX_SUGGESTED} unknown labels per scene and "
                f"{MAX_MAPPED} per batch to the nearest class"
            )
        suggestions: list[str] = []
        searched = self.look_ups.searched
        may_search = key in searched or len(searched) < MAX_SUGGESTED
        if may_search and self.look_ups.suggestions < MAX_SUGGESTED:
            searched.add(key)
            matches = self.vocabulary.nearest(label, is_room=is_room)
            suggestions = [names[match.entry] for match in matches]
        self.look_ups.suggestions += bool(suggestions)
        errors.add(UnknownLabelsError, location, message, suggestions)


class Names:
    """Look-up of the objects of a scene by id, or by label if only one object has the label."""

    def __init__(
        self, objects: Sequence[SceneObject], unknown: Unknown, left_out: Sequence[tuple[str, str]]
    ) -> None:
        self._objects, self._unknown = objects, unknown
        self._ignored_ids = {ignored_id for ignored_id, _ in left_out}
        self._ignored_labels = {label_key(label) for _, label in left_out}

    # The first access builds each table, because most requests do not refer to objects by name.

    @cached_property
    def _by_id(self) -> dict[str, int]:
        return {thing.id: index for index, thing in enumerate(self._objects)}

    @cached_property
    def _by_name(self) -> dict[str | int | None, list[int]]:
        """The objects with each label and of each class."""
        indices: dict[str | int | None, list[int]] = {}
        for index, thing in enumerate(self._objects):
            indices.setdefault(thing.label, []).append(index)
            indices.setdefault(thing.class_index, []).append(index)
        return indices

    @cached_property
    def _plain_ids(self) -> list[str]:
        # A request cannot put arbitrary text into an error through its ids.
        return [thing.id for thing in self._objects if PLAIN.fullmatch(thing.id.replace(" ", "_"))]

    def find(self, name: str, location: Location, errors: ErrorList) -> int | None:
        """Return the index of the object with an id, or else a label. On failure, add an error."""
        if (index := self._by_id.get(name)) is not None:
            return index
        indices = self._by_name.get(name)
        if indices is None:
            of_class = self._unknown.index(name)
            indices = [] if of_class is None else self._by_name.get(of_class, [])
        if len(indices) == 1:
            return indices[0]
        similar: list[str] = []
        if indices:
            message = (
                f"{len(indices)} objects have this label; use the id of one of them. The service "
                "numbers objects without an id, such as chair_1 and chair_2"
            )
        elif self.is_ignored(name):
            message = "the service ignored this object, because the model does not know its label"
        else:
            message, similar = "no entry of `objects` has this id or label", self._similar(name)
        errors.add(InvalidRequestError, location, message, similar)
        return None

    def _similar(self, name: str) -> list[str]:
        """Return similar ids for the first `MAX_SUGGESTED` unknown names of a request."""
        if self._unknown.look_ups.suggestions >= MAX_SUGGESTED:
            return []
        self._unknown.look_ups.suggestions += 1
        return spelt_alike(name, self._plain_ids)

    def is_ignored(self, name: str) -> bool:
        """Return whether an ignored object has this id or label."""
        if name in self._by_id:
            return False
        return name in self._ignored_ids or label_key(name) in self._ignored_labels
