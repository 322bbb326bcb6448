"""Analyse the labels of scenes: frequencies, spellings, and pairs of similar labels."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

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
# A name is merged into a similar name if it has at least `_MERGED_LENGTH` letters and is rare. A
# rare name has at most two objects, or at most the share `_RARE` of the objects of the other name.
_RARE, _MERGED_LENGTH = 0.1, 6
# Maximum number of labels in the text of `outside_vocabulary`. Further labels are only counted.
_SHOWN = 8


@dataclass(frozen=True)
class Label:
    """One name of objects, with all its spellings."""

    name: str  # curated name, or the most frequent spelling
    mentions: int  # number of objects with this name
    spellings: tuple[str, ...]  # most frequent first


@dataclass(frozen=True)
class Lookalike:
    """Two names that differ by a likely typing error."""

    name: str  # the rarer name
    like: str  # the more frequent name
    mentions: tuple[int, int]  # number of objects with each of the two names
    merged: bool  # the rarer name becomes an alias; otherwise the user has to decide
    why: str


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


def lookalikes(
    labels: Sequence[Label], scenes: Sequence[AnnotatedScene], names: Names
) -> list[Lookalike]:
    """Find pairs of names that differ by one or two letters, and mark clear misspellings as merged.

    Two curated names, or two names with different digits, are different objects and form no pair.
    Two names that occur in the same scene form a pair that is not merged.
    """
    compared = [label for label in labels[:_COMPARED] if len(label_key(label.name)) >= _ONE_SLIP]
    curated = {label_key(name) for name in (*names.base, *names.aliases, *names.structure)}
    pairs = list(_similar_pairs([label_key(label.name) for label in compared]))
    names_in_pairs = {compared[k].name for pair in pairs for k in pair}
    in_one_scene = _pairs_in_one_scene(names_in_pairs, scenes, names)
    similar: list[Lookalike] = []
    merged_names: set[str] = set()
    for i, j in pairs:
        # Labels are sorted by frequency, so the second name of a pair is rarer.
        frequent, rare = compared[i], compared[j]
        keys = {label_key(frequent.name), label_key(rare.name)}
        digits = {"".join(filter(str.isdigit, key)) for key in keys}
        if keys <= curated or len(digits) == 2:
            continue
        objection = _objection(frequent, rare, in_one_scene)
        # A name is merged at most once, and never into a merged name.
        if not objection and merged_names & {rare.name, frequent.name}:
            objection = "similar to several names"
        if not objection:
            merged_names.add(rare.name)
        why = objection or "rare, one or two letters differ, never in one scene"
        mentions = (rare.mentions, frequent.mentions)
        similar.append(Lookalike(rare.name, frequent.name, mentions, not objection, why))
    return similar


def _objection(frequent: Label, rare: Label, in_one_scene: Collection[frozenset[str]]) -> str:
    """Return the reason against merging two similar names, or "".

    `in_one_scene` contains the pairs of names that occur in the same scene.
    """
    frequent_key, rare_key = label_key(frequent.name), label_key(rare.name)
    if frozenset((frequent.name, rare.name)) in in_one_scene:
        return "both occur in one scene"
    is_short = min(len(frequent_key), len(rare_key)) < _MERGED_LENGTH
    if is_short or frequent_key[0] != rare_key[0]:
        return "short, or different first letter"
    if rare.mentions > max(2, _RARE * frequent.mentions):
        return "both are frequent"
    return ""


def _similar_pairs(keys: Sequence[str]) -> Iterator[tuple[int, int]]:
    """Generate the index pairs of keys that differ by one edit, or by two edits if long."""
    for i, key in enumerate(keys):
        slips = 2 if len(key) >= _TWO_SLIPS else 1
        later = keys[i + 1 :]
        matches = process.extract(key, later, scorer=OSA.distance, limit=None, score_cutoff=slips)
        yield from ((i, i + 1 + offset) for _, _, offset in matches)


def _pairs_in_one_scene(
    compared: set[str], scenes: Sequence[AnnotatedScene], names: Names
) -> set[frozenset[str]]:
    """Return the pairs of names in `compared` that occur in the same scene."""
    by_key = {label_key(name): name for name in compared}
    name_of = cache(lambda label: by_key.get(label_key(names.canonical(label))))
    together: set[frozenset[str]] = set()
    for scene in scenes:
        present = {name for thing in scene.objects if (name := name_of(thing.label)) is not None}
        together |= set(map(frozenset, combinations(present, 2)))
    return together
