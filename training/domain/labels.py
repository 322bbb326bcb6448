"""Labels of scenes: their spellings, likely typing errors, and labels without a class."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

from rapidfuzz import process
from rapidfuzz.distance import OSA

from app.scene import label_key
from training.datasets import AnnotatedScene, EncodedScene
from training.datasets.names import Names
from training.datasets.vocabulary import most_frequent

# Maximum number of names that are compared with each other, most frequent names first.
_COMPARED = 2000
# Minimum number of letters of two similar names that differ by one edit, or by two edits.
_ONE_SLIP, _TWO_SLIPS = 5, 10
# Maximum number of labels in the text of `outside_vocabulary`. Further labels are only counted.
_SHOWN = 8


@dataclass(frozen=True)
class Label:
    """One name of objects, with all its spellings."""

    name: str  # curated name, or the most frequent spelling
    mentions: int  # number of objects with this name
    spellings: tuple[str, ...]  # most frequent first


def outside_vocabulary(scenes: Iterable[EncodedScene], *, named: bool) -> str:
    """Return one line that counts or names the labels outside the vocabulary, "" without any."""
    with_labels = [scene.unknown for scene in scenes if scene.unknown]
    spellings: dict[str, Counter[str]] = {}
    for label, count in Counter(label for labels in with_labels for label in labels).items():
        spellings.setdefault(label_key(label), Counter())[label] += count
    if not spellings:
        return ""
    counts = [(-spelt.total(), most_frequent(spelt)) for spelt in spellings.values()]
    listed = [f'"{label}" ({_number(-count, "scene")})' for count, label in sorted(counts)[:_SHOWN]]
    listed += [f"{len(counts) - _SHOWN:,} more"] if len(counts) > _SHOWN else []
    are, they = ("is", "it is") if len(counts) == 1 else ("are", "they are")
    return (
        f"{_number(len(counts), 'label')} in {_number(len(with_labels), 'scene')} {are} not in "
        f"the vocabulary{': ' + ', '.join(listed) if named else ''}; {they} left out"
    )


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def count_labels(scenes: Iterable[AnnotatedScene], names: Names) -> list[Label]:
    """Count all names, most frequent first. Spellings with the same key count as one name."""
    spellings: defaultdict[str, Counter[str]] = defaultdict(Counter)
    names_of: defaultdict[str, Counter[str]] = defaultdict(Counter)
    canonical = cache(names.canonical)
    for thing in (thing for scene in scenes for thing in scene.objects):
        name = canonical(thing.label)
        key = label_key(name)
        spellings[key][thing.label] += 1
        names_of[key][name] += 1
    labels = []
    for key, counts in spellings.items():
        spelt = tuple(sorted(counts, key=lambda label: (-counts[label], label)))
        labels.append(Label(most_frequent(names_of[key]), counts.total(), spelt))
    return sorted(labels, key=lambda label: (-label.mentions, label.name))


def similar_labels(labels: Sequence[Label], names: Names) -> Iterator[tuple[Label, Label]]:
    """Generate pairs (rarer, more frequent) of names that differ by a likely typing error.

    The names differ by one edit, or by two edits if long. Two curated names, or two names with
    different digits, are different objects and form no pair.
    """
    compared = [label for label in labels[:_COMPARED] if len(label_key(label.name)) >= _ONE_SLIP]
    keys = [label_key(label.name) for label in compared]
    curated = {label_key(name) for name in (*names.base, *names.aliases, *names.structure)}
    for i, key in enumerate(keys):
        slips = 2 if len(key) >= _TWO_SLIPS else 1
        later = keys[i + 1 :]
        for other, _, offset in process.extract(
            key, later, scorer=OSA.distance, limit=None, score_cutoff=slips
        ):
            digits = {"".join(filter(str.isdigit, text)) for text in (key, other)}
            if len(digits) == 1 and not {key, other} <= curated:
                # Labels are sorted by frequency.
                yield compared[i + 1 + offset], compared[i]
