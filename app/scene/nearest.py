"""Search for the known names that are most similar to an unknown name.

The similarity of two names is the larger of two values:

    spelling   1 - edits / length of the longer name. Two exchanged letters are one edit.
    words      0 if the last words of the names differ. If the last words are equal ("coffee mug"
               and "mug"), the value rises with the number of common words.

A second search ignores words for size, colour and material: a "big lamp" is a "lamp".

The module does not use word vectors, because they find wrong classes too often. The nearest class
by cosine similarity is right for only 40 % of held-out aliases. Even if distant classes are
rejected, less than 85 % of the results are right (GloVe 6B, 100 dimensions, 20,000 words).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from rapidfuzz import process
from rapidfuzz.distance import OSA

from app.scene.labels import split_words

ACCEPTED: Final = 0.8
"""Minimum similarity at which the nearest known name replaces an unknown name.

This value is the lowest multiple of 0.05 at which 90 % of the replacements are right. The test
names are aliases that the search does not know, and misspelt names. In the `indoor` vocabulary,
2724 of 2895 replacements are right. For the aliases alone, 572 of 727 replacements are right.
"""

LONGEST: Final = 64
"""Maximum length of a name whose spelling the search compares, in characters.

The length counts after Unicode normalisation, which can turn one character into 18. The time of a
comparison grows with the length. All class names have fewer than 32 characters.
"""

_LEAST: Final = 0.6  # minimum similarity of a suggestion
_BY_KIND: Final = 0.95  # factor if the search ignored words for size, colour or material
_BY_REST: Final = 0.9  # factor if the first letters differ, because people rarely mistype them
_FARTHER: Final = 0.1  # maximum difference of similarity between a suggestion and the best one


_LOOKS: Final = frozenset(
    "big small large little tiny huge tall short long low high old new wide narrow round square "  # noqa: SIM905
    "red green blue yellow orange purple pink brown black white grey gray beige dark light wooden "
    "wood metal plastic leather steel golden silver".split()
)


class Match(NamedTuple):
    """A known entry that is similar to the unknown name.

    Attributes:
        entry: index of the entry.
        similarity: similarity of the entry's name and the unknown name, from 0 to 1.
    """

    entry: int
    similarity: float


class NameIndex:
    """Search for entries, such as object classes, with names similar to an unknown name.

    Args:
        names: pairs (name, index of the entry). An entry may have several names.
    """

    def __init__(self, names: Sequence[tuple[str, int]]) -> None:
        self._entries = [index for _, index in names]
        self._words = [split_words(name) for name, _ in names]
        self._keys = ["".join(words) for words in self._words]
        self._by_head: dict[str, list[int]] = {}
        for place, words in enumerate(self._words):
            self._by_head.setdefault(_head(words), []).append(place)

    def nearest(self, name: str, limit: int) -> tuple[Match, ...]:
        """Return at most ``limit`` plausible entries, most similar first."""
        words = split_words(name)
        best = self._similarities(words)
        kind = [word for word in words if word not in _LOOKS]
        if 0 < len(kind) < len(words):
            for index, similarity in self._similarities(kind).items():
                _keep(best, index, _BY_KIND * similarity)
        ranked = sorted(best.items(), key=lambda entry: (-entry[1], entry[0]))[:limit]
        least = max(_LEAST, ranked[0][1] - _FARTHER) if ranked else 0.0
        return tuple(Match(*entry) for entry in ranked if entry[1] >= least)

    def _similarities(self, words: Sequence[str]) -> dict[int, float]:
        """Map each entry with a similar name to its similarity."""
        best: dict[int, float] = {}
        if not words:
            return best
        joined = "".join(words)
        if len(joined) <= LONGEST:
            found = process.extract(
                joined,
                self._keys,
                scorer=OSA.normalized_similarity,
                limit=None,
                score_cutoff=_LEAST,
            )
            for key, similarity, place in found:
                begins_alike = key[:1] == words[0][:1]
                _keep(best, self._entries[place], similarity * (1 if begins_alike else _BY_REST))
        kin = self._by_head.get(_head(words), ())
        is_only = len({self._entries[place] for place in kin}) == 1
        for place in kin:
            similarity = _in_common(words, self._words[place], is_only=is_only)
            _keep(best, self._entries[place], similarity)
        return best


def spelt_alike(name: str, known: Sequence[str], limit: int = 3) -> list[str]:
    """Return known names with a similar spelling, most similar first, without reading words."""
    found = process.extract(
        name[:LONGEST],
        [other[:LONGEST] for other in known],
        scorer=OSA.normalized_similarity,
        limit=limit,
        score_cutoff=_LEAST,
    )
    return [known[place] for _, _, place in found]


def _keep(best: dict[int, float], index: int, similarity: float) -> None:
    best[index] = max(similarity, best.get(index, 0.0))


def _head(words: Sequence[str]) -> str:
    """Return the head word of a name: the word before "of", or the last word without "of"."""
    return words[words.index("of", 1) - 1] if "of" in words[1:] else words[-1]


def _in_common(words: Sequence[str], known: Sequence[str], *, is_only: bool) -> float:
    """Return the similarity of two names with the same head word.

    The similarity depends on the common words. If the unknown name has all words of the known name
    and more, it probably names a subclass ("coffee mug" of "mug"). An unknown name with fewer words
    may belong to another class.

    A head word is ambiguous if the names of several entries have it. These figures are for aliases
    that the search does not know. If only one entry has the head word, 86 % of the aliases belong
    to this entry. If several entries have the head word, 59 % of the aliases belong to the entry
    whose name is only the head word.

    Args:
        words: words of the unknown name.
        known: words of the known name.
        is_only: whether only one entry has names with this head word.
    """
    one, other = set(words), set(known)
    shared = len(one & other)
    if other <= one:
        if shared == 1 and len(one) > 1:
            return 0.875 if is_only else 0.75
        return 0.75 + 0.25 * shared / len(one)
    return (0.5 if one <= other else 0.3) + 0.25 * shared / len(one | other)
