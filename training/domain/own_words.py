"""The words of a home that its model cannot read: they become classes and room types.

A new class is judged once `JUDGED` scenes show it. A home has at most `MAX_NEW` new classes, those
of most scenes, and `MAX_NEW_ROOMS` new room types.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

from app.model import SceneModel
from app.scene import ObjectClass, label_key
from training.datasets import AnnotatedScene
from training.datasets.vocabulary import curated_names
from training.fit.adapt import extended

JUDGED: Final = 3  # number of scenes with a new class from which its objects are judged
MAX_NEW: Final = 200
MAX_NEW_ROOMS: Final = 32


def with_new_words(
    model: SceneModel, recorded: Sequence[AnnotatedScene]
) -> tuple[SceneModel, tuple[str, ...]]:
    """Return the model with the words that it cannot read, and the words beyond the limits."""
    names, vocabulary = curated_names(), model.vocabulary
    scenes_of: Counter[str] = Counter()
    rooms_of: Counter[str] = Counter()
    for scene in recorded:
        labels = {label_key(thing.label): thing.label for thing in scene.objects}.values()
        scenes_of.update({names.canonical(x) for x in labels if vocabulary.look_up(x) is None})
        room = names.canonical_room(scene.room_type)
        if room is not None and names.room_index(scene.room_type, vocabulary) is None:
            rooms_of[room] += 1
    excluded = set(map(label_key, (*names.not_objects, *names.structure)))
    words = [x for x in _commonest(scenes_of) if label_key(x) and label_key(x) not in excluded]
    rooms = _commonest(rooms_of)
    classes = [ObjectClass(x, anywhere=scenes_of[x] < JUDGED) for x in sorted(words[:MAX_NEW])]
    new_rooms = sorted(rooms[:MAX_NEW_ROOMS]) if model.spec.C else ()
    return extended(model, classes, new_rooms), (*words[MAX_NEW:], *rooms[MAX_NEW_ROOMS:])


def _commonest(counts: Counter[str]) -> list[str]:
    """Return the words, the commonest first, one for each key."""
    ordered = sorted(counts, key=lambda word: (-counts[word], word))
    by_key = {label_key(word): word for word in reversed(ordered)}
    return [word for word in ordered if by_key[label_key(word)] == word]
