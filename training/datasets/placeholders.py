"""Labels that name no kind of object: placeholders of annotators, ids of detectors and catalogues.

A class of such a label (REMOVE, object_7, n03001627, /m/01mzpv) would teach only how often a tool
failed, so scenes and inventories are read without it. A sense of WordNet names a kind: sofa.n.01.
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
    name, names = without_instance(text), curated_names()
    empty = {*names.placeholders, *(() if name == text else names.numbered)}
    words = [word for word in split_words(name) if not word.isdigit()]
    joined = label_key("".join(words))
    return joined in names.placeholders or (bool(words) and empty.issuperset(words))


def plain_label(label: str) -> str:
    """Return the curated name in a label: chair for "chair_12", sofa for "sofa.n.01"."""
    names = curated_names()
    # The number of a label without a curated name may distinguish kinds: "screw m4".
    if names.is_curated(label) or not names.is_curated(name := without_instance(label)):
        return label
    return name


def plain_scenes(scenes: Iterable[AnnotatedScene]) -> tuple[list[AnnotatedScene], Counter[str]]:
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
