"""Labels that name no kind of object: placeholders of annotators, ids of detectors and catalogues.

Recordings of the field have labels such as REMOVE, unknown, object_7, n03001627 or /m/01mzpv. A
class of such a label would teach the model only how often a tool failed. So the scenes and
inventories of a user are read without them. A sense of WordNet names a kind: sofa.n.01 is a sofa.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import Final

from app.scene import label_key
from app.scene.labels import split_words, without_instance
from training.datasets.records import AnnotatedScene
from training.datasets.vocabulary import curated_names

# A label is a placeholder if all its words are among these: "unknown object", "other_things_3".
# So is a label that is one of these when its words are joined: "N/A", "don't care".
_EMPTY: Final = frozenset(
    (
        *("object", "obj", "thing", "item", "entity", "instance", "stuff", "clutter"),
        *("unknown", "unk", "undefined", "undef", "unlabeled", "unlabelled", "unannotated"),
        *("unidentified", "unclassified", "uncategorized", "unrecognized", "unnamed", "untitled"),
        *("none", "null", "nil", "nan", "na", "notapplicable", "void", "invalid", "ignore"),
        *("ignored", "dontcare", "remove", "removed", "delete", "deleted", "split", "merge"),
        *("merged", "background", "groundplane", "misc", "miscellaneous", "other", "otherprop"),
        *("otherfurniture", "otherstructure", "default", "placeholder", "todo", "tbd", "class"),
        *("cls", "category"),
    )
)
# These words are real names on their own. With a number, they are ids: "track 7", "label_12".
_NUMBERED: Final = frozenset(
    (
        *("id", "track", "cluster", "region", "segment", "node", "label", "part", "mesh", "model"),
        *("blob", "detection", "proposal", "mask", "link", "body", "prim", "dummy", "geom"),
        *("index", "type"),
    )
)
# Catalogue numbers: offsets of WordNet, mids of Freebase, uuids and other hexadecimal ids.
_CATALOGUE: Final = re.compile(
    r"[nvars]\d{8}|/[mg]/[\da-z_]{2,}|(?=[a-f\-]*\d)[\da-f][\da-f\-]{5,}", re.IGNORECASE
)


@lru_cache(maxsize=4096)
def is_placeholder(label: str) -> bool:
    """Return True if a label names no kind of object."""
    text = label.strip()
    if not any(map(str.isalpha, text)) or _CATALOGUE.fullmatch(text) is not None:
        return True
    name = without_instance(text)
    empty = _EMPTY if name == text else _EMPTY | _NUMBERED
    words = [word for word in split_words(name) if not word.isdigit()]
    return label_key("".join(words)) in _EMPTY or (bool(words) and empty.issuperset(words))


def plain_label(label: str) -> str:
    """Return the label, or the known name in it: chair for "chair_12", sofa for "sofa.n.01".

    A label without a known name stays, because its number may tell kinds apart: "screw m4".
    """
    names = curated_names()
    if names.knows(label) or not names.knows(name := without_instance(label)):
        return label
    return name


def plain_scenes(
    scenes: Iterable[AnnotatedScene],
) -> tuple[list[AnnotatedScene], Counter[str]]:
    """Return the scenes with plain labels and without placeholders, and the left-out labels."""
    left_out: Counter[str] = Counter()
    plain = []
    for scene in scenes:
        empty = [is_placeholder(thing.label) for thing in scene.objects]
        left_out.update(x.label for x, drop in zip(scene.objects, empty, strict=True) if drop)
        if any(empty):
            scene = scene.only([k for k, drop in enumerate(empty) if not drop])
        labels = [plain_label(thing.label) for thing in scene.objects]
        if labels != [thing.label for thing in scene.objects]:
            pairs = zip(scene.objects, labels, strict=True)
            scene = replace(scene, objects=tuple(replace(x, label=label) for x, label in pairs))
        plain.append(scene)
    return plain, left_out


def left_out_line(left_out: Counter[str], most: int) -> str:
    """Return one line that names the left-out labels and how often each occurs, "" without any."""
    if not left_out:
        return ""
    named = ", ".join(f"{label} ({count})" for label, count in left_out.most_common(most))
    more = f" and {len(left_out) - most} more" if len(left_out) > most else ""
    return f"left out, because they name no kind of object: {named}{more}"
