"""The known names nearest to an unknown one, by spelling and by common words.

    spelling   1 - edits / length of the longer name; two exchanged letters are one edit
    words      the same last word, and how many of the others are shared: "coffee mug" is a "mug"

The similarity of two names is the larger of the two. Words for size, colour and material are passed
over where the whole name finds less: a "big lamp" is a "lamp". Word vectors are left out: the class
with the largest cosine is right for 40 % of held-out aliases, and at no cosine for 85 % or more
(GloVe 6B, 100 dimensions, 20,000 words).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from rapidfuzz import process
from rapidfuzz.distance import OSA

from app.scene.labels import split_words

ACCEPTED: Final = 0.8
"""From this similarity on the nearest name may stand for the unknown one.

The lowest multiple of .05 at which 90 % of the mappings are right, of held-out aliases and
misspelt names of the `indoor` vocabulary together: 2724 of 2895; of held-out aliases alone 572 of
727.
"""

LONGEST: Final = 64
"""Characters of a name whose spelling is compared, after folding: one character may become 18. No
class has a name half as long, and the cost of a comparison grows with the length."""

_LEAST: Final = 0.6  # "asdf" is not a misspelt "scarf"
_BY_KIND: Final = 0.95  # of a name without its words for looks
_BY_REST: Final = 0.9  # people rarely mistype the first letter: a pocket is not a socket
_FARTHER: Final = 0.1  # a suggestion this much less similar than the best one is noise


_LOOKS: Final = frozenset(
    "big small large little tiny huge tall short long low high old new wide narrow round square "  # noqa: SIM905
    "red green blue yellow orange purple pink brown black white grey gray beige dark light wooden "
    "wood metal plastic leather steel golden silver".split()
)


class Match(NamedTuple):
    """A known entry and its similarity, in [0, 1]."""

    entry: int
    similarity: float


class NameIndex:
    """Finds entries by names like theirs.

    Args:
        names: (name, number of its entry); an entry may have several names.
    """

    def __init__(self, names: Sequence[tuple[str, int]]) -> None:
        self._entries = [index for _, index in names]
        self._words = [split_words(name) for name, _ in names]
        self._keys = ["".join(words) for words in self._words]
        self._by_head: dict[str, list[int]] = {}
        for place, words in enumerate(self._words):
            self._by_head.setdefault(_head(words), []).append(place)

    def nearest(self, name: str, limit: int) -> tuple[Match, ...]:
        """The plausible entries, most similar first, at most ``limit``."""
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
        """The entries with a similar name."""
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


def _keep(best: dict[int, float], index: int, similarity: float) -> None:
    best[index] = max(similarity, best.get(index, 0.0))


def _head(words: Sequence[str]) -> str:
    """The word that names the thing: the last one, or the one before "of"."""
    return words[words.index("of", 1) - 1] if "of" in words[1:] else words[-1]


def _in_common(words: Sequence[str], known: Sequence[str], *, is_only: bool) -> float:
    """How much of a name with the same head is shared.

    A name that says more than a known one is a kind of it; one that says less may be another kind.
    A head word is ambiguous if several entries share it. If one entry has it, 86 % of held-out
    aliases belong to that entry. If several have it, 59 % belong to the entry of that name.

    Args:
        is_only: no other entry has a name with this head.
    """
    one, other = set(words), set(known)
    shared = len(one & other)
    if other <= one:
        if shared == 1 and len(one) > 1:
            return 0.875 if is_only else 0.75
        return 0.75 + 0.25 * shared / len(one)
    return (0.5 if one <= other else 0.3) + 0.25 * shared / len(one | other)
