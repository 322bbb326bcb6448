"""What a stream keeps between messages: a scene, and the answers that its client has.

A message is merged into the scene when it comes, or refused and changes nothing. Only the scene as
it is now is ever computed, so what a newer message has replaced costs nothing. Sessions outlive
their connections for a while; none of this knows of WebSockets.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from types import MappingProxyType
from typing import Any, Final

from app.changes import Entry, difference
from app.messages import Alarms, AnswerMessage, Ask, SceneMessage, Update, Whole
from app.schemas import (
    Answer,
    Detection,
    MissingAnswer,
    MissingOptions,
    MissingRequest,
    ModelReference,
    OutliersAnswer,
    OutliersOptions,
    OutliersRequest,
    Relation,
    RelationsAnswer,
    RelationsRequest,
    SceneRequest,
)
from app.serving import questions
from app.serving.answers import scene_notes, written
from app.serving.errors import Fault, Location, Reason, RequestError
from app.serving.metrics import Metrics
from app.serving.reading import Faults, Names
from app.serving.session import Session

PARKED_BYTES: Final = 16 * 2**20
"""What all sessions without a connection may take together."""

_DEFAULT_ASK: Final = Ask(missing=MissingOptions(), outliers=OutliersOptions())
# What a whole scene leaves as it is, unless it says otherwise.
_KEPT: Final = frozenset({"model", "unknown_labels"})
_FIELDS: Final = frozenset(SceneRequest.model_fields) - {"objects", "seed"}
_IN_FORCE: Final = frozenset({"coverage", "threshold"})
_ANSWERS: Final[dict[str, type[Answer]]] = {
    "missing": MissingAnswer,
    "outliers": OutliersAnswer,
    "relations": RelationsAnswer,
}


# ---------------------------------------------------------------------------------- the scene


@dataclass(frozen=True, slots=True)
class SceneState:
    """The scene of a session, and what is asked about it.

    Attributes:
        objects: by id, in the order in which they came.
        fields: the other fields of `SceneRequest`, as far as they were given.
        ask: the questions.
        timeout_ms: the client's own, for each answer.
    """

    objects: Mapping[str, Detection] = field(default_factory=dict)
    fields: Mapping[str, Any] = field(default_factory=dict)
    ask: Ask = _DEFAULT_ASK
    timeout_ms: int | None = None

    def request(self) -> SceneRequest:
        """The scene as one request would send it."""
        return SceneRequest(objects=list(self.objects.values()), **self.fields)

    def after(self, message: SceneMessage, view: Session) -> SceneState:
        """The scene with a message merged into it.

        Raises:
            RequestError: the message or the scene that would result makes no sense.
            UnknownModelError, ModelUnavailableError: see `Session.read`.
        """
        faults = Faults()
        whole = isinstance(message, Whole)
        objects = {} if whole else dict(self.objects)
        fields = {name: value for name, value in self.fields.items() if not whole or name in _KEPT}
        if isinstance(message, Update) and message.remove:
            _remove(message.remove, objects, faults)
            _leave_out(fields, self.objects.keys() - objects.keys())
        places: dict[str, Location] = {}
        for place, entry in enumerate(message.objects):
            thing = _named(entry)
            name = thing.id or ""
            if name in places:
                faults.add(Reason.INVALID, ("objects", place, "id"), "another object has this id")
            places[name] = ("objects", place)
            objects[name] = thing
        if len(objects) > view.limits.objects:
            text = f"the scene would hold more than {view.limits.objects} objects"
            faults.add(Reason.INVALID, ("objects",), text)
        faults.raise_any()
        given = message.model_fields_set
        fields |= {name: getattr(message, name) for name in given & _FIELDS}
        found = replace(
            self,
            objects=objects,
            fields=fields,
            ask=message.ask or self.ask,
            timeout_ms=message.timeout_ms if "timeout_ms" in given else self.timeout_ms,
        )
        try:
            names = view.check(found.request())
        except RequestError as error:
            bare = {entry for entry in message.objects if isinstance(entry, str)}
            raise _located(error, list(objects), places, given, bare) from None
        if message.relations is None:
            return found
        fields["relations"] = _by_ids(message.relations, objects, names)
        return replace(found, fields=fields)

    def dump(self) -> bytes:
        """All of it as JSON."""
        message = SceneMessage(
            objects=list(self.objects.values()),
            ask=self.ask,
            timeout_ms=self.timeout_ms,
            **self.fields,
        )
        return message.model_dump_json(exclude_unset=True).encode()

    @classmethod
    def load(cls, dumped: bytes) -> SceneState:
        """What `dump` wrote."""
        message = SceneMessage.model_validate_json(dumped)
        things = map(_named, message.objects)
        given = message.model_fields_set & _FIELDS
        return cls(
            {thing.id or "": thing for thing in things},
            {name: getattr(message, name) for name in given},
            message.ask or _DEFAULT_ASK,
            message.timeout_ms,
        )


def _named(entry: str | Detection) -> Detection:
    """An object with an id: its own, or its label."""
    if isinstance(entry, str):
        return Detection(id=entry, label=entry)
    return entry if entry.id is not None else entry.model_copy(update={"id": entry.label})


def _remove(names: list[str], objects: dict[str, Detection], faults: Faults) -> None:
    for place, name in enumerate(names):
        if objects.pop(name, None) is None:
            text = "no object of the scene has this id"
            faults.add(Reason.INVALID, ("remove", place), text)


def _leave_out(fields: dict[str, Any], removed: set[str]) -> None:
    if fields.get("relations"):
        fields["relations"] = [
            relation
            for relation in fields["relations"]
            if relation.subject not in removed and relation.object not in removed
        ]


def _by_ids(
    relations: list[Relation], objects: Mapping[str, Detection], names: Names
) -> list[Relation]:
    """Relations that go on naming the same objects, whatever comes later.

    Those of an object that is ignored, named by its label, are left out, as they are of answers.
    """
    found = []
    for relation in relations:
        subject = _id(relation.subject, objects, names)
        other = _id(relation.object, objects, names)
        if subject is not None and other is not None:
            found.append(Relation(subject=subject, relation=relation.relation, object=other))
    return found


def _id(name: str, objects: Mapping[str, Detection], names: Names) -> str | None:
    return name if name in objects else names.id(name)


def _located(
    error: RequestError,
    ids: Sequence[str],
    places: Mapping[str, Location],
    given: Set[str],
    bare: Set[str],
) -> RequestError:
    """The same faults where the message has them, or under ``session`` where only the scene has.

    Args:
        ids: of the objects of the scene.
        places: of those that the message holds.
        given: the message's fields.
        bare: ids of objects that are labels in the message, with nothing inside.
    """

    def located(location: Location) -> Location:
        if location[0] == "objects" and len(location) > 1:
            name = ids[int(location[1])]
            if name in places:
                return places[name] if name in bare else (*places[name], *location[2:])
            return ("session", "objects", name, *location[2:])
        return location if location[0] in given else ("session", *location)

    faults = [
        Fault(located(fault.location), fault.message, fault.suggestions) for fault in error.faults
    ]
    return RequestError(error.reason, faults)


# ---------------------------------------------------------------------------------- the answers


@dataclass(frozen=True, slots=True)
class _Found:
    """Whole answers about one scene.

    Attributes:
        notes: fields of `Answer` about the scene: what was ignored or mapped, and warnings.
        in_force: settings of the answers that may be the model's own.
        lists: the lists of the answers, by name, as JSON has them.
        failures: questions that this scene cannot be asked.
    """

    model: ModelReference
    request: SceneRequest
    notes: dict[str, Any]
    in_force: dict[str, Any]
    lists: dict[str, list[Entry]]
    failures: dict[str, RequestError]


async def _answer(state: SceneState, view: Session) -> _Found:
    request = state.request()
    model, reading = view.read(request, may_be_empty=True)
    found = _Found(model.reference, request, scene_notes(reading), {}, {}, {})
    if reading.observed is not None:
        found.lists["observed_relations"] = [
            {"subject": seen.subject, "relation": seen.relation, "object": seen.object}
            for seen in reading.observed
        ]
    # All questions are about one reading, and have one time.
    asked = replace(view, known=(model, reading), gives_way=True)
    for name in ("missing", "outliers", "relations"):
        options = getattr(state.ask, name)
        if options is None:
            continue
        if not reading.scene.objects:
            found.lists.update({own: [] for own in _own(_ANSWERS[name])})
            continue
        fields: dict[str, Any] = {"objects": request.objects, **state.fields}
        # No more than was given: what is left out may mean something else than its default.
        fields |= {option: getattr(options, option) for option in options.model_fields_set}
        try:
            if name == "missing":
                answer = await questions.missing(asked, MissingRequest(**fields))
            elif name == "outliers":
                answer = await questions.outliers(asked, OutliersRequest(**fields))
            else:
                answer = await questions.relations(asked, RelationsRequest(**fields))
        except RequestError as error:
            # Without the frames, of which one has this dictionary.
            found.failures[name] = error.with_traceback(None)
        else:
            found.in_force.update({own: answer[own] for own in _IN_FORCE & answer.keys()})
            lists = {own: answer[own] for own in _own(_ANSWERS[name])}
            written(lists)  # no number that is not finite leaves, as in an answer to a request
            found.lists.update(lists)
    return found


def _own(kind: type[Answer]) -> list[str]:
    """The lists that one question's answer has and the others' have not."""
    return [
        name for name in kind.model_fields if name not in Answer.model_fields.keys() | _IN_FORCE
    ]


def _alarms(before: Mapping[str, list[Entry]], after: Mapping[str, list[Entry]]) -> Alarms:
    def alarmed(lists: Mapping[str, list[Entry]]) -> list[str]:
        return [entry["object"] for entry in lists.get("outliers", ()) if entry["is_outlier"]]

    old, new = alarmed(before), alarmed(after)
    return Alarms(
        raised=[name for name in new if name not in old],
        cleared=[name for name in old if name not in new],
    )


class StreamSession:
    """One client's scene, and the answers it has.

    Attributes:
        id: cannot be guessed.
        state: the scene as it is now.
        seq: of the newest message that was taken.
        revision: how many answers there were.
        pending: messages taken since the last one.
    """

    def __init__(self) -> None:
        self.id = secrets.token_urlsafe(18)
        self.state = SceneState()
        self.seq = 0
        self.revision = 0
        self.pending = 0
        self._before: _Found | None = None

    def take(self, message: SceneMessage, view: Session) -> int:
        """Merge a message into the scene; how many messages wait for the next answer.

        Raises:
            RequestError, UnknownModelError, ModelUnavailableError: see `SceneState.after`; nothing
                has changed.
        """
        if isinstance(message, Whole | Update):
            if message.seq <= self.seq:
                text = "must be greater than that of the newest message taken"
                raise RequestError(Reason.INVALID, [Fault(("seq",), text)])
            self.state = self.state.after(message, view)
            self.seq = message.seq
            self.pending += 1
        else:
            self.state = self.state.after(message, view)
        return self.pending

    def start_over(self) -> None:
        """Let the next answer be a full one: what the client has is not known, or not wanted."""
        self._before = None

    async def answer(self, view: Session) -> tuple[AnswerMessage, dict[str, RequestError]]:
        """What has changed with the scene as it is now, and which questions it cannot be asked.

        Raises:
            RequestError: this model does not know the scene; see `Session.read`.
            UnknownModelError, ModelUnavailableError, NotReadyError: see `Session.read`.
            QueueFullError, DeadlinePassedError: see `Session.ask`.
        """
        seq, covered = self.seq, self.pending
        try:
            found = await _answer(self.state, view)
        except RequestError as error:
            nothing: frozenset[str] = frozenset()
            raise _located(error, list(self.state.objects), {}, nothing, nothing) from None
        before = self._before
        # Of another model no list is comparable.
        full = before is None or before.model != found.model
        lists = {} if before is None or full else before.lists
        changes, dropped = difference(lists, found.lists)
        self.revision += 1
        self.pending -= covered
        self._before = found
        failures = {
            name: RequestError(
                error.reason,
                [replace(fault, location=("ask", name, *fault.location)) for fault in error.faults],
            )
            for name, error in found.failures.items()
        }
        message = AnswerMessage(
            seq=seq,
            superseded=max(0, covered - 1),
            revision=self.revision,
            full=full,
            model=found.model,
            frame_id=found.request.frame_id,
            stamp=found.request.stamp,
            **found.notes,
            **found.in_force,
            changes=changes,
            dropped=dropped,
            alarms=_alarms(lists, found.lists),
        )
        return message, failures


# ------------------------------------------------------------------------------- many sessions


class Ending(Enum):
    """Why the service ends a stream that has done nothing wrong."""

    DRAINING = "draining"
    REPLACED = "replaced"


@dataclass(frozen=True, slots=True)
class _Parked:
    """A session without a connection, as small as it gets."""

    scene: bytes
    seq: int
    revision: int
    expiry: asyncio.TimerHandle


class Streams:
    """All streams of a process, and the sessions that may be taken up again.

    Args:
        limit: most streams at once, and most sessions that are kept without one.
        keep: seconds for which they are.
        metrics: counts the streams.
    """

    def __init__(self, limit: int, keep: float, metrics: Metrics) -> None:
        self.limit = limit
        self.keep = keep
        self._metrics = metrics
        self._open: set[Callable[[Ending], None]] = set()
        self._live: dict[str, tuple[StreamSession, Callable[[Ending], None]]] = {}
        self._parked: OrderedDict[str, _Parked] = OrderedDict()

    @property
    def is_full(self) -> bool:
        """Whether one more stream would be too many."""
        return len(self._open) >= self.limit

    @property
    def parked(self) -> Mapping[str, int]:
        """Sessions without a connection, oldest first, and the bytes that each takes."""
        return MappingProxyType({name: len(one.scene) for name, one in self._parked.items()})

    @contextmanager
    def place(self, end: Callable[[Ending], None]) -> Iterator[None]:
        """The place of one stream.

        Args:
            end: lets it end soon; called at most once.
        """
        self._open.add(end)
        self._metrics.streams(len(self._open))
        try:
            yield
        finally:
            self._open.discard(end)
            self._metrics.streams(len(self._open))

    def drain(self) -> None:
        """Let every stream end once the answer under way is given."""
        for end in tuple(self._open):
            self._open.discard(end)
            end(Ending.DRAINING)

    def find(self, name: str) -> StreamSession | None:
        """A session that is kept, or that another stream has; it stays where it is."""
        if (live := self._live.get(name)) is not None:
            return live[0]
        if (parked := self._parked.get(name)) is None:
            return None
        session = StreamSession()
        session.id, session.seq, session.revision = name, parked.seq, parked.revision
        session.state = SceneState.load(parked.scene)
        return session

    def bind(self, session: StreamSession, end: Callable[[Ending], None]) -> None:
        """Give a session to a stream; another one that had it ends."""
        if (live := self._live.pop(session.id, None)) is not None:
            live[1](Ending.REPLACED)
        if (parked := self._parked.pop(session.id, None)) is not None:
            parked.expiry.cancel()
        self._live[session.id] = session, end

    def part(self, session: StreamSession, end: Callable[[Ending], None], *, keep: bool) -> None:
        """Take a session from a stream, unless another has it by now.

        Args:
            keep: for whoever resumes it.
        """
        live = self._live.get(session.id)
        if live is None or live[1] != end:
            return
        del self._live[session.id]
        if keep and self.keep > 0:
            self._park(session)

    def _park(self, session: StreamSession) -> None:
        scene = session.state.dump()
        if len(scene) > PARKED_BYTES:
            return
        expiry = asyncio.get_running_loop().call_later(self.keep, self._expire, session.id)
        self._parked[session.id] = _Parked(scene, session.seq, session.revision, expiry)
        while len(self._parked) > self.limit or sum(self.parked.values()) > PARKED_BYTES:
            self._expire(next(iter(self._parked)))

    def _expire(self, name: str) -> None:
        self._parked.pop(name).expiry.cancel()
