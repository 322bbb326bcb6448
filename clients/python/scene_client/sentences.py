"""Answers and errors as sentences for a language model, with the numbers that they rest on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from typing import Final, TypeAlias

from scene_client import phrases
from scene_client.errors import (
    ClientError,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
)
from scene_client.phrases import PREPOSITIONS
from scene_client.schemas import (
    Answer,
    GenerateAnswer,
    MissingAnswer,
    OutliersAnswer,
    RelationsAnswer,
    RoomsAnswer,
    ScoredRelation,
    WhereAnswer,
)
from scene_client.schemas.missing import MissingObject
from scene_client.schemas.outliers import MisplacedRelation
from scene_client.schemas.where import Searched, Spot

LIKELY: Final = 0.5
"""Minimum probability of a fact. An answer lists the others as possible."""
MENTIONED: Final = 0.05
"""Minimum probability of a possible room or relation."""
MOST: Final = 12
"""Maximum number of entries of a list."""
_DOUBTFUL: Final = 0.1  # minimum probability of a fault that is named without an alarm
_LIKELY_PLACE: Final = 0.25  # minimum probability of the place of a missing object
_MOST_SPOTS: Final = 4  # maximum number of places in a room
_LEAST_SPOT: Final = 0.01
_SEEN: Final = 0.5  # seen share from which a place counts as searched

Fact: TypeAlias = tuple[str, float, str]
"""A name, its probability and a further note, which may be empty."""


def text(
    answer: Answer,
    sentences: Iterable[str],
    rooms: Collection[str] = (),
    unused: Collection[str] = (),
) -> str:
    """Return an answer as text: first the omitted and guessed words, then the warnings.

    Args:
        answer: the answer.
        sentences: sentences about the answer.
        rooms: names of rooms in the request, whose objects count if the name is unknown.
        unused: relations, or objects of an imagined room, that the request does not have.
    """
    words = [*_words(answer, rooms)]
    if unused:
        rule = "I use relations between listed objects, and none beside measured positions"
        if isinstance(answer, GenerateAnswer):
            rule = "the kind of the room decides"
        words.append(f"I left out {', '.join(map(_quoted, unused))} ({rule}).")
    return " ".join([*words, *_warnings(answer), *sentences])


def _quoted(name: str) -> str:
    return f'"{name}"'


def _words(answer: Answer, rooms: Collection[str]) -> Iterator[str]:
    hint = "ask again with a commoner word, if there is one"
    if ignored := [f'"{name}"' for name in answer.ignored if name not in rooms]:
        pronoun = "it" if len(ignored) == 1 else "them"
        yield f"I do not know {', '.join(ignored)} and left {pronoun} out ({hint})."
    if unknown := [f'"{name}"' for name in answer.ignored if name in rooms]:
        yield f"I do not know the kind of room {', '.join(unknown)}, and go by the objects there."
    for entry in answer.mapped:
        if entry.rule in ("spelling", "head"):
            yield f'I read "{entry.label}" as {entry.class_} (a guess).'
        elif entry.rule == "meaning":
            guess = f"near {entry.class_} (a weak guess; {hint})"
            yield f'I know "{entry.label}" only by its meaning, {guess}.'
        elif entry.class_ not in entry.label.lower():
            yield f'I read "{entry.label}" as {entry.class_}.'
    named = {entry.label for entry in answer.mapped}
    for one in answer.outliers if isinstance(answer, OutliersAnswer) else ():
        word = one.listed_as
        if word and word not in named and word.lower().rstrip("s") != one.label:
            yield f'I read "{word}" as {one.label}.'


def _warnings(answer: Answer) -> Iterator[str]:
    for warning in answer.warnings:
        if warning.code == "not-judged" and isinstance(answer, OutliersAnswer):
            continue  # `out_of_place` says it
        if warning.rooms:
            parts = "; ".join(f"{one.room_type}: {', '.join(one.objects)}" for one in warning.rooms)
            yield f"These are probably objects of several rooms ({parts}): ask about each room."
        else:
            names = f"{', '.join(warning.objects)}: " if warning.objects else ""
            yield f"Note: {names}{warning.message}."


def out_of_place(answer: OutliersAnswer) -> Iterator[str]:
    """Say which objects do not belong, which are in wrong places, and which are not judged."""
    guessed = {entry.label for entry in answer.mapped if entry.rule == "meaning"}
    warned = {name for one in answer.warnings if one.code == "not-judged" for name in one.objects}
    groups: dict[str, list[Fact]] = {name: [] for name in ("odd", "unreal", "doubtful", "fitting")}
    unknown = []
    for one in answer.outliers:
        is_weak = guessed & {one.label, one.listed_as} or one.object in warned
        if one.log_odds is None or (is_weak and not one.is_outlier):
            unknown.append(one.object)
        elif one.is_outlier:
            usual = f"usually with {', '.join(one.usually_with)}" if one.usually_with else ""
            groups["odd"].append((one.object, one.probability, usual))
        elif one.reason == "misdetection":
            groups["unreal"].append((one.object, 1 - (one.real or 0), ""))
        else:
            group = "doubtful" if one.probability >= _DOUBTFUL else "fitting"
            groups[group].append((one.object, one.probability, ""))
    places = [(one.is_misplaced, (_wrong(one), one.probability, "")) for one in answer.misplaced]
    moved = [place for is_alarm, place in places if is_alarm]
    groups["doubtful"] += [one for is_alarm, one in places if not is_alarm and one[1] >= _DOUBTFUL]
    yield from _facts("Out of place", groups["odd"])
    yield from _facts("In a wrong place", moved)
    yield from _facts("Probably wrong detections", groups["unreal"])
    yield from _facts("Perhaps wrong, but no alarm", groups["doubtful"])
    if unknown:
        yield f"Not judged, as it may be anywhere or I know it too little: {', '.join(unknown)}."
    if fitting := groups["fitting"]:
        is_all = len(fitting) + len(unknown) == len(answer.outliers) and not moved
        some = " judged" if unknown or answer.ignored else ""
        most = max(0.01, *(probability for _, probability, _ in fitting))
        lead = f"All{some} objects fit" if is_all else "All else fits"
        yield f"{lead} (each at most {most:.2f})."


def _wrong(entry: MisplacedRelation) -> str:
    if entry.reason == "floats":
        return f"{entry.subject} in the air"
    if entry.reason == "sunk-in":
        return f"{entry.subject} partly inside {entry.object}"
    return _relation(entry)


def missing(answer: MissingAnswer, *, only: bool) -> Iterator[str]:
    """Say which objects are probably there beside the listed ones, and where.

    Args:
        answer: the answer.
        only: whether the request names the candidates.
    """
    entries = [(one.listed_as or one.label, one.probability, _place(one)) for one in answer.missing]
    doubt = "None of these is likelier than not; a low number is no proof of absence."
    unsure = doubt if only else "I am sure of no further object."
    yield from _split(entries, "Probably also there", unsure)
    if answer.more:
        counts = (f"{one.label} (about {one.expected_count:.0f})" for one in answer.more[:MOST])
        yield f"Probably more of: {', '.join(counts)}."


def _place(entry: MissingObject) -> str:
    place = next(iter(entry.placements), None)
    if place is None or place.probability < _LIKELY_PLACE:
        return ""
    words = f"{PREPOSITIONS[place.relation]} {place.object}"
    if place.offset is None:
        return words
    mean = place.offset.mean
    x, y, z = (round(value, 2) + 0.0 for value in (mean.x, mean.y, mean.z))
    return f"{words}, at its centre + [{x}, {y}, {z}] m"


def where(
    answer: WhereAnswer, labels: phrases.Labels, searched: Collection[Searched]
) -> Iterator[str]:
    """Say in which rooms and at which places the thing may be.

    Args:
        answer: the answer.
        labels: labels of the objects with ids.
        searched: places that were searched without success. A search can overlook the thing, so
            they may still be likely, but a planner looks at the others first.
    """
    thing, kind = answer.listed_as or answer.label, answer.label if answer.listed_as else ""
    spots = [spot for spot in answer.places if spot.probability >= _LEAST_SPOT and spot.object]
    new = [spot for spot in spots if not _is_searched(spot, labels, searched)]
    rooms = []
    for room in answer.rooms:
        likely = [spot for spot in spots if spot.room == room.room][:_MOST_SPOTS]
        is_whole = any(one.room == room.room and one.object is None for one in _seen(searched))
        notes = ["already searched"] * is_whole
        notes += [
            f"{_spot(one, kind, labels)} {_number(one.probability)}"
            + " (already searched)" * (one not in new and not is_whole)
            for one in likely
        ]
        rooms.append((room.room, room.probability, ", ".join(notes)))
    entries = [room for room in rooms if room[1] >= MENTIONED]
    yield from _split(entries, f"Probable place of {thing}", f"I am not sure about {thing}.")
    best = max(new, key=lambda spot: spot.probability, default=None)
    if best is not None and entries and best.room != entries[0][0]:
        place = f"{_spot(best, '', labels)} in {best.room} ({_number(best.probability)})"
        yield f"Best {'unsearched' if searched else 'single'} place: {place}."
    yield f"In none of these rooms: {_number(answer.not_here)}."


def _seen(searched: Collection[Searched]) -> Iterator[Searched]:
    return (one for one in searched if one.seen_share >= _SEEN)


def _is_searched(spot: Spot, labels: phrases.Labels, searched: Collection[Searched]) -> bool:
    names = (None, spot.object, labels.get((spot.room, spot.object or "")))
    return any(one.room == spot.room and one.object in names for one in _seen(searched))


def _spot(spot: Spot, kind: str, labels: phrases.Labels) -> str:
    """Return a place in words. ``kind`` is the class of the thing, if it has another name."""
    if spot.is_listed or spot.relation is None:
        return f"already seen: {spot.object}{f', if you mean any {kind}' if kind else ''}"
    return phrases.spot(spot, labels)


def rooms(answer: RoomsAnswer, objects: Collection[str]) -> Iterator[str]:
    """Say which room has these objects, or in which rooms a single object is."""
    entries = [
        (" or ".join(one.listed_as or [one.room_type]), one.probability, "")
        for one in answer.room_types
        if one.probability >= MENTIONED
    ]
    if len(objects) > 1:
        yield from _split(entries, "This is probably", "I am not sure which room this is.")
    else:
        (thing,) = objects
        yield from _split(entries, f"Usual rooms of {thing}", f"I am not sure about {thing}.")
    if not any(one.because for one in answer.room_types):
        yield "No object points clearly to one of these rooms."


def relations(answer: RelationsAnswer) -> Iterator[str]:
    """Say how the objects stand to each other, and which known relation is unusual."""
    known = [one for one in answer.relations if one.observed]
    if known:
        said = (
            f"{_relation(one)} (unusual: {_number(one.expected)})"
            if one.expected is not None and one.expected < MENTIONED
            else _relation(one)
            for one in known[:MOST]
        )
        yield f"Known: {', '.join(said)}."
    others = [(_relation(one), one.probability, "") for one in answer.relations if not one.observed]
    yield from _split(others, "Likely", f"I am sure of no {'other ' * bool(known)}relation.")


def imagined(answer: GenerateAnswer, given: Collection[str]) -> Iterator[str]:
    """Say how often sampled rooms have which objects and places, beside the given ones."""
    words, total = answer.listed_as or {}, len(answer.scenes)
    kinds = Counter(one.room_type or "unknown" for one in answer.scenes)
    things = Counter(words.get(name, name) for one in answer.scenes for name in one.objects)
    # Left and front of single samples are as random as the viewer.
    places = Counter(
        (words.get(r.subject, r.subject), PREPOSITIONS[r.relation], words.get(r.object, r.object))
        for one in answer.scenes
        for r in one.relations
        if r.relation not in ("left", "right", "front", "behind")
    )
    yield f"I imagined {total} rooms, and give the share of them."
    yield from _facts("Kind of room", [(name, n / total, "") for name, n in kinds.most_common(3)])
    yield from _split(
        [(name, n / total, "") for name, n in things.most_common(2 * MOST) if name not in given],
        *("Usual objects", "No object is in most of them."),
    )
    common = [(" ".join(names), n / total, "") for names, n in places.most_common(MOST)]
    yield from _facts("Places", [place for place in common if place[1] > MENTIONED])


def _relation(entry: ScoredRelation) -> str:
    return f"{entry.subject} {PREPOSITIONS[entry.relation]} {entry.object}"


def _split(facts: Iterable[Fact], likely: str, unsure: str) -> Iterator[str]:
    """Return likely facts, then possible ones. Without a likely fact, first state the doubt."""
    facts = list(facts)
    sure = [fact for fact in facts if fact[1] >= LIKELY]
    yield from _facts(likely, sure)
    if not sure:
        yield unsure
    yield from _facts("Possible", [fact for fact in facts if fact[1] < LIKELY])


def _facts(lead: str, facts: Collection[Fact]) -> Iterator[str]:
    if facts:
        listed = [
            f"{name} ({'; '.join(filter(None, (_number(probability), note)))})"
            for name, probability, note in list(facts)[:MOST]
        ]
        yield f"{lead}: {', '.join(listed)}{', …' if len(facts) > MOST else ''}."


def _number(probability: float) -> str:
    if probability > 0.99:
        return ">0.99"
    return "<0.01" if probability < 0.01 else f"{probability:.2f}"


def failure(error: ClientError) -> str:
    """Return an error of a client as one sentence, which says what to do."""
    if isinstance(error, InvalidRequestError):
        return f"Correct the arguments: {error}."
    if isinstance(error, UnreachableError):
        return f"The scene service does not answer: start it, or correct its address ({error})."
    if isinstance(error, DeadlineError):
        return "The scene service took too long: ask again, or about fewer objects."
    if not isinstance(error, ProblemError):
        return str(error)
    if error.status == 401:
        return "The scene service wants another API key: set SCENE_API_KEY, or over HTTP X-API-Key."
    if error.status in (429, 503):
        return "The scene service is busy or not ready: ask again in some seconds."
    if error.errors:
        faults = "; ".join(
            one.message + (f" (did you mean {', '.join(one.suggestions)}?)" * bool(one.suggestions))
            for one in error.errors[:MOST]
        )
        is_word = error.type == "/problems/unknown-labels"
        return f"{'Use another word' if is_word else 'Correct the arguments'}: {faults}."
    return f"The scene service refused the question: {error.title} ({error.detail})"
