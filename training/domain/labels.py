"""What scenes call their things: how often, in which spellings, and which names look like one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from rapidfuzz import process
from rapidfuzz.distance import OSA

from app.scene import label_key
from training.datasets import AnnotatedScene, Names

# Only so many of the most frequent names are compared with each other, and told of.
_COMPARED = 2000
# A slip of one letter in names of five and more, of two in names of ten and more.
_ONE_SLIP, _TWO_SLIPS = 5, 10
# A misspelling is rare beside what it misspells, and too short a name says little.
_RARE, _MERGED_LENGTH = 0.1, 6


@dataclass(frozen=True)
class Label:
    """One name under all its spellings.

    Attributes:
        name: as the vocabulary would have it.
        mentions: objects so called; scenes: in how many.
        spellings: as annotated, the most frequent first.
    """

    name: str
    mentions: int
    scenes: int
    spellings: tuple[str, ...]


@dataclass(frozen=True)
class Lookalike:
    """Two names that a slip of the keyboard may have parted.

    Attributes:
        name: the rarer one; like: the other.
        mentions: of both.
        merged: the rarer one is proposed as an alias; otherwise somebody has to look.
        why: in a few words.
    """

    name: str
    like: str
    mentions: tuple[int, int]
    merged: bool
    why: str


def count_labels(scenes: Iterable[AnnotatedScene], names: Names) -> list[Label]:
    """Every name, the most frequent first: spellings with one key and curated aliases are one."""
    spellings: dict[str, Counter[str]] = {}
    shown: dict[str, Counter[str]] = {}
    seen: Counter[str] = Counter()
    canonical: dict[str, tuple[str, str]] = {}
    for scene in scenes:
        here = set()
        for thing in scene.objects:
            if thing.label not in canonical:
                name = names.canonical(thing.label)
                canonical[thing.label] = (label_key(name), name)
            key, name = canonical[thing.label]
            spellings.setdefault(key, Counter())[thing.label] += 1
            shown.setdefault(key, Counter())[name] += 1
            here.add(key)
        seen.update(here)
    found = [
        Label(
            name=_first(shown[key]),
            mentions=counts.total(),
            scenes=seen[key],
            spellings=tuple(sorted(counts, key=lambda label: (-counts[label], label))),
        )
        for key, counts in spellings.items()
    ]
    return sorted(found, key=lambda label: (-label.mentions, label.name))


def _first(counts: Counter[str]) -> str:
    return min(counts, key=lambda label: (-counts[label], label))


def lookalikes(
    labels: Sequence[Label], scenes: Sequence[AnnotatedScene], names: Names
) -> list[Lookalike]:
    """Pairs of names a letter or two apart; the rarer is merged where it can hardly be meant.

    Two curated names are different things, however alike they look. Names that differ by a digit
    are numbered on purpose, and names that stand side by side in a scene are likely two things.
    """
    compared = [label for label in labels[:_COMPARED] if len(label_key(label.name)) >= _ONE_SLIP]
    curated = {label_key(name) for name in (*names.base, *names.aliases, *names.structure)}
    pairs = list(_pairs([label_key(label.name) for label in compared]))
    together = _together({compared[k].name for pair in pairs for k in pair}, scenes, names)
    found = []
    for i, j in pairs:
        # Labels come by frequency: the second is the rarer one.
        like, rare = compared[i], compared[j]
        keys = label_key(like.name), label_key(rare.name)
        if set(keys) <= curated or _digits(keys[0]) != _digits(keys[1]):
            continue
        if frozenset((like.name, rare.name)) in together:
            merged, why = False, "both in one scene"
        elif min(map(len, keys)) < _MERGED_LENGTH or keys[0][0] != keys[1][0]:
            merged, why = False, "short, or begins otherwise"
        elif rare.mentions > max(2, _RARE * like.mentions):
            merged, why = False, "both are frequent"
        else:
            merged, why = True, "rare, a letter or two apart, never side by side"
        mentions = (rare.mentions, like.mentions)
        found.append(Lookalike(rare.name, like.name, mentions, merged, why))
    return _once(found)


def _pairs(keys: Sequence[str]) -> Iterator[tuple[int, int]]:
    for i, key in enumerate(keys):
        slips = 2 if len(key) >= _TWO_SLIPS else 1
        rest = process.extract(
            key, keys[i + 1 :], scorer=OSA.distance, limit=None, score_cutoff=slips
        )
        yield from ((i, i + 1 + place) for _, _, place in rest)


def _digits(key: str) -> str:
    return "".join(letter for letter in key if letter.isdigit())


def _together(
    wanted: set[str], scenes: Sequence[AnnotatedScene], names: Names
) -> set[frozenset[str]]:
    """Which of the wanted names stand side by side in a scene."""
    by_key = {label_key(name): name for name in wanted}
    known: dict[str, str | None] = {}
    found: set[frozenset[str]] = set()
    for scene in scenes:
        here = set()
        for thing in scene.objects:
            if thing.label not in known:
                known[thing.label] = by_key.get(label_key(names.canonical(thing.label)))
            if (name := known[thing.label]) is not None:
                here.add(name)
        found |= {frozenset((a, b)) for a in here for b in here if a < b}
    return found


def _once(found: list[Lookalike]) -> list[Lookalike]:
    """A name is merged into one other, and never into one that is merged itself."""
    merged: set[str] = set()
    kept = []
    for pair in found:
        if pair.merged and (pair.name in merged or pair.like in merged):
            pair = replace(pair, merged=False, why="alike to more than one")
        if pair.merged:
            merged.add(pair.name)
        kept.append(pair)
    return kept
