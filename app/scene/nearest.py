"""Search for the known name that an unknown name probably stands for.

`NameIndex.guess` returns an entry only if a wrong entry is improbable, because a wrong class is
worse than none. It reads a name in two ways:

    spelling   Misspelt words, such as "nigthstand". The edits lie within words, and their number
               depends on the length of the word. Another entry with a similar spelling makes the
               name ambiguous.
    head       The last words of a phrase, such as "office table", without words after a preposition
               ("table on wheels"). Modifiers alone decide nothing.

`NameIndex.nearest` returns plausible entries for error messages. The module does not use word
vectors, because the nearest class by cosine similarity is right for only 40 % of held-out aliases.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from rapidfuzz import process
from rapidfuzz.distance import OSA, Indel

from app.scene.labels import LookUp, head_of, split_words

LONGEST: Final = 64
"""Maximum length of a name whose spelling the search compares, in characters.

The length counts after Unicode normalisation. All class names have fewer than 32 characters.
"""

_LEAST: Final = 0.7  # minimum similarity of a suggestion
_BY_REST: Final = 0.9  # factor if the first letters differ, because people rarely mistype them
_SAME_HEAD: Final = 0.5  # minimum similarity of names with the same last word
_FARTHER: Final = 0.1  # maximum difference of similarity between a suggestion and the best one

# Costs of edits: 1 for a letter too many or too few, 2 for another letter or two exchanged letters,
# and 1 more for another first or last letter, which people rarely mistype.
_BY_PHRASE: Final = 1  # additional cost if the other words of the phrase agree
_MARGIN: Final = 1  # two entries with costs as close as this make a name ambiguous
_MOST_EDITS: Final = 2
_MOST_CORRECTIONS: Final = 6
_MOST_WORDS: Final = 8
_MOST_MISSPELT: Final = 2  # number of words of a phrase
_SHORTEST: Final = 4  # number of letters; a shorter word with a mistake can be anything
_BY_HEAD: Final = 0.9  # factor if modifiers are unknown

_PREPOSITIONS: Final = frozenset(
    ("of", "with", "on", "in", "for", "behind", "under", "below", "above", "over", "near", "beside")
)
# These words join two objects: "stove and oven", and "vase with flowers" if both are known.
_SEVERAL: Final = frozenset(("and", "or", "&", "+", "without"))
_TOGETHER: Final = frozenset(("with", "in"))
# A "toy trailer" is a toy, and a "puppet cat" is a puppet.
_IMITATIONS: Final = frozenset(("toy", "stuffed", "plush", "puppet"))
# A modifier changes the meaning of these words: "cell" means a phone, but "jail cell" means a room.
_AMBIGUOUS: Final = frozenset(
    "bar board boat burner button can cap card cell chip cleaner conditioner console controller "  # noqa: SIM905
    "cooker cover cream cube cycle die disc dish disk draw dressing dryer equipment file "
    "filing foundation frame glass ground hall handle hanger holder hood horse iron island jam "
    "jelly keyboard letter mail maker marble mint mold monitor nail nut oil pack pad part paste "
    "pepper phone plate player plug pole polish present rail receiver register ring roll salt "
    "scooter screen self shade sheet shower slab spray stand stick stopper string switch "
    "tablet tank tape throw tie top tower trunk tub tube vest washer washing weight".split()
)


class Match(NamedTuple):
    """A known entry that is similar to the unknown name."""

    entry: int
    similarity: float  # of both names, from 0 to 1


class NameIndex:
    """Search for entries by similar names, from pairs (name, index). An entry may have several."""

    def __init__(self, names: Sequence[tuple[str, int]]) -> None:
        """Split the names into words. Index them by key (joined words), last word and length."""
        self._entries = [index for _, index in names]
        self._words = [split_words(name) for name, _ in names]
        self._keys = ["".join(words) for words in self._words]
        self._by_key = dict(zip(self._keys, self._entries, strict=True))
        self._by_head: dict[str, list[int]] = {}
        for row, words in enumerate(self._words):
            self._by_head.setdefault(words[-1], []).append(row)
        self._entry_words = {word for words in self._words for word in words}
        self._lexicon: dict[int, list[str]] = {}  # by length
        for word in sorted({*self._entry_words, *self._keys}):
            self._lexicon.setdefault(len(word), []).append(word)

    def guess(self, name: str) -> LookUp | None:
        """Return the entry whose name or last words a name probably stands for, or None."""
        words = split_words(head_of(name) or name)
        if len("".join(words)) > LONGEST or len(words) > _MOST_WORDS or _SEVERAL & {*words}:
            return None
        unknown = {*words} - self._entry_words
        corrections = {word: [(word, 0)] for word in words}
        if len(unknown) <= _MOST_MISSPELT:
            corrections |= {word: self._corrections(word) for word in unknown}
        if (guess := self._by_corrections(words, corrections)) is not None:
            return guess
        prepositions = [k for k, word in enumerate(words) if k and word in _PREPOSITIONS]
        end = prepositions[0] if prepositions else len(words)
        # "vase with flowers" names two objects.
        names_two = bool(_TOGETHER & {*words[end : end + 1]})
        if names_two and self._by_corrections(words[end + 1 :], corrections) is not None:
            return None
        return self._by_head_words(words[:end])

    def _by_head_words(self, words: Sequence[str]) -> LookUp | None:
        """Return the entry of the longest end of a phrase, or of its imitation ("toy"), or None."""
        imitations = [word for word in words[:-1] if word in _IMITATIONS]
        for start in range(len(words)):
            head = imitations[:1] or words[start:]
            if start and len(head) == 1 and head[0] in _AMBIGUOUS:
                return None
            if (entry := self._by_key.get("".join(head))) is not None:
                return LookUp(entry, _BY_HEAD, "head")
        return None

    def _by_corrections(
        self, words: Sequence[str], corrections: Mapping[str, Sequence[tuple[str, int]]]
    ) -> LookUp | None:
        """Return the one entry that the phrase names with few enough misspellings, or None."""
        costs: dict[int, tuple[int, int]] = {}  # by entry: cost and maximum cost
        for spelling in itertools.product(*(corrections[word] for word in words)):
            entry = self._by_key.get("".join(word for word, _ in spelling))
            if entry is None:
                continue
            cost = sum(cost for _, cost in spelling)
            max_cost = sum(_max_cost(word) for word, cost in spelling if cost)
            if max_cost and len(words) > 1:
                max_cost += _BY_PHRASE
            costs[entry] = min((cost, max_cost), costs.get(entry, (cost, max_cost)))
        if not costs:
            return None
        (entry, (cost, max_cost)), *others = sorted(costs.items(), key=lambda item: item[1])
        second_cost = min((other_cost for _, (other_cost, _) in others), default=math.inf)
        if cost > max_cost or second_cost - cost <= _MARGIN:
            return None
        return LookUp(entry, round(1 - cost / 2 / len("".join(words)), 3), "spelling")

    def _corrections(self, word: str) -> list[tuple[str, int]]:
        """Return at most `_MOST_CORRECTIONS` pairs (word of the lexicon, cost), cheapest first."""
        if len(word) < _SHORTEST:
            return [(word, 0)]
        lengths = range(max(_SHORTEST, len(word) - _MOST_EDITS), len(word) + _MOST_EDITS + 1)
        candidates = [other for length in lengths for other in self._lexicon.get(length, ())]
        most = _MOST_EDITS + _BY_PHRASE
        matches = process.extract(
            word, candidates, scorer=Indel.distance, limit=None, score_cutoff=most
        )
        corrections = [
            (other, cost + (other[0] != word[0]) + (other[-1] != word[-1]))
            for other, cost, _ in matches
        ]
        cheapest = sorted(corrections, key=lambda correction: correction[1])[:_MOST_CORRECTIONS]
        return cheapest or [(word, 0)]

    def nearest(self, name: str, limit: int) -> tuple[Match, ...]:
        """Return at most ``limit`` plausible entries, most similar first.

        An entry is plausible if its name has a similar spelling or the same last word ("office
        table" and "table"). Entries that are much less similar than the first one are left out.
        """
        words = split_words(name)
        candidates = [*self._by_spelling("".join(words)), *self._by_last_word(words)]
        # In ascending order, the largest similarity of each entry is the last one.
        best = {match.entry: match for match in sorted(candidates, key=lambda m: m.similarity)}
        ranked = sorted(best.values(), key=lambda match: (-match.similarity, match.entry))[:limit]
        if not ranked:
            return ()
        least = max(_LEAST, ranked[0].similarity - _FARTHER)
        return tuple(match for match in ranked if match.similarity >= least)

    def _by_spelling(self, key: str) -> Iterator[Match]:
        """Yield the entries whose names have a spelling similar to ``key``, a name in one word."""
        if len(key) > LONGEST:
            return
        for similar_key, similarity, row in _alike(key, self._keys):
            factor = 1 if similar_key[:1] == key[:1] else _BY_REST
            yield Match(self._entries[row], similarity * factor)

    def _by_last_word(self, words: Sequence[str]) -> Iterator[Match]:
        """Yield the entries whose names have the same last word."""
        for row in self._by_head.get(words[-1], ()) if words else ():
            entry_words = self._words[row]
            shared = len({*words} & {*entry_words}) / len({*words, *entry_words})
            yield Match(self._entries[row], _SAME_HEAD + (1 - _SAME_HEAD) * shared)


def spelt_alike(name: str, names: Sequence[str]) -> list[str]:
    """Return up to three names of similar spelling, most similar first, without reading words."""
    matches = _alike(name[:LONGEST], [other[:LONGEST] for other in names], 3)
    return [names[row] for _, _, row in matches]


def _alike(
    name: str, names: Sequence[str], limit: int | None = None
) -> list[tuple[str, float, int]]:
    """Return triples (similar name, similarity, index of the name), most similar first."""
    similarity = OSA.normalized_similarity
    return process.extract(name, names, scorer=similarity, limit=limit, score_cutoff=_LEAST)


def _max_cost(word: str) -> int:
    """Return the maximum cost of the edits that lead to a word of the lexicon."""
    return 1 if len(word) < 5 else _MOST_EDITS
