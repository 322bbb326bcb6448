"""Search for the known name that an unknown name probably stands for.

`NameIndex.guess` returns an entry only if a wrong entry is improbable, because a wrong class is
worse than none. It reads a name in two ways:

    spelling   Misspelt words, such as "nigthstand". The edits lie within words, and their number
               depends on the length of the word. English words are misspelt only in a known phrase:
               "power stripe". Another entry at a similar distance makes the name ambiguous, unless
               it is much rarer.
    head       The last words of a phrase, such as "office table", without words after a preposition
               ("table on wheels"). Modifiers alone decide nothing. The last word needs its sense:
               "jail cell" does not mean a cell phone, nor "ground plane" an airplane.

`NameIndex.nearest` returns plausible entries for error messages. The module does not compare word
vectors, because the nearest class by cosine similarity is right for only 40 % of held-out aliases.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from rapidfuzz import process
from rapidfuzz.distance import OSA

from app.scene.labels import (
    NEGATIONS,
    LookUp,
    head_of,
    label_key,
    plain_words,
    singular,
    split_words,
)
from app.scene.words import word_vectors

LONGEST: Final = 64
"""Maximum length of a name whose spelling the search compares, in characters.

The length counts after Unicode normalisation. All class names have fewer than 32 characters.
"""

_LEAST: Final = 0.7  # minimum similarity of a suggestion
_BY_REST: Final = 0.9  # factor if the first letters differ, because people rarely mistype them
_SAME_HEAD: Final = 0.5  # minimum similarity of names with the same last word
_FARTHER: Final = 0.1  # maximum difference of similarity between a suggestion and the best one

# The cost of a correction is the number of edits (OSA distance), and more for another first or last
# letter, which people rarely mistype.
_BY_FIRST: Final = 2
_BY_LAST: Final = 1
_MOST_JOINED: Final = 1  # cost of a correction to several words of a name in one: "trascan"
_MARGIN: Final = 1  # two entries with costs as close as this make a long name ambiguous
_LONG: Final = 8  # letters
_RARER: Final = 16  # of two similar entries, the rarer one is so many times as far from the first
_MOST_CORRECTIONS: Final = 8
_MOST_WORDS: Final = 8
_MOST_MISSPELT: Final = 2  # number of words of a phrase
_MOST_ENGLISH: Final = 4  # number of words of a phrase with an English word in the wrong place
_SHORTEST: Final = 4  # number of letters; a shorter word with a mistake can be anything
_BY_HEAD: Final = 0.9  # factor if modifiers are unknown
_SAME_SENSE: Final = 0.5  # share of the names with a last word that are kinds of one entry

_PREPOSITIONS: Final = frozenset(
    "of with on in at for behind under below above over near beside".split()  # noqa: SIM905
)
# These words join two objects: "stove and oven", and "vase with flowers" if both are known.
_SEVERAL: Final = frozenset(("and", "or", "&", "+", *NEGATIONS))
_TOGETHER: Final = frozenset(("with", "in"))
# These words add nothing to the word before them: "piano lower part", "sandal type of shoe".
_PARTS: Final = frozenset(("part", "lower", "upper", "type", "kind"))
# A "toy trailer" is a toy, and a "puppet cat" is a puppet.
_IMITATIONS: Final = frozenset(("toy", "stuffed", "plush", "puppet"))
# A modifier changes the meaning of these words: a "baseball cap" is a hat, but not a "bottle cap".
_AMBIGUOUS: Final = frozenset(
    "alcohol board boat cap card chip cone cooker cracker cradle die dish disk dressing earth "  # noqa: SIM905
    "flute foundation frame glass ground handle hanger heel jam letter log mail marble match "
    "mate mint mobile monitor nail nut pad peg plug polish powder present range recorder "
    "robot rose self server shower spot squash stand string syrup throw trunk tube washer "
    "weight wool".split()
)


class Match(NamedTuple):
    """A known entry that is similar to the unknown name."""

    entry: int
    similarity: float  # of both names, from 0 to 1


class NameIndex:
    """Search for entries by similar names.

    The names are pairs (name, index), the commonest entry first. An entry may have several names,
    its label first. ``parents`` has the index of the broader entry of each entry, or -1.
    """

    def __init__(self, names: Sequence[tuple[str, int]], parents: Sequence[int] = ()) -> None:
        """Split the names into words. Index them by key (joined words), last word and length."""
        self._entries, self._parents = [index for _, index in names], parents
        self._labels = {index: label_key(name) for name, index in reversed(names)}
        self._words = [split_words(name) for name, _ in names]
        self._phrases = frozenset(self._words)
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
        typed = plain_words(head_of(name) or name)
        words = tuple(map(singular, typed))
        if len("".join(words)) > LONGEST or len(words) > _MOST_WORDS or _SEVERAL & {*words}:
            return None
        if (guess := self._by_corrections(typed)) is not None:
            return guess
        prepositions = [k for k, word in enumerate(words) if k and word in _PREPOSITIONS]
        end = prepositions[0] if prepositions else len(words)
        # "vase with flowers" names two objects.
        names_two = bool(_TOGETHER & {*words[end : end + 1]})
        if names_two and self._by_corrections(typed[end + 1 :]) is not None:
            return None
        while end > 1 and words[end - 1] in _PARTS:
            end -= 1
        return self._by_head_words(words[:end])

    def _by_head_words(self, words: Sequence[str]) -> LookUp | None:
        """Return the entry of the longest end of a phrase, or of its imitation ("toy"), or None."""
        imitations = [word for word in words[:-1] if word in _IMITATIONS]
        for start in range(len(words)):
            head = imitations[:1] or words[start:]
            if (entry := self._by_key.get("".join(head))) is not None:
                keeps_sense = not start or self._keeps_sense(words[start - 1], head, entry)
                return LookUp(entry, _BY_HEAD, "head") if keeps_sense else None
        return None

    def _keeps_sense(self, modifier: str, head: Sequence[str], entry: int) -> bool:
        """Return whether the last words of a phrase still name an entry after a modifier."""
        # A "lamp desk" is perhaps a desk lamp.
        if self._by_key.get("".join((*head, modifier)), entry) != entry:
            return False
        if len(head) > 1:
            return True
        # The label completes a short name, so another modifier makes another thing: the "remote" of
        # "remote control".
        word, label = head[0], self._labels[entry]
        if word in _AMBIGUOUS or (word in label and word != label):
            return False
        # Half of the known names with this last word must be names of the entry or its kinds.
        others = [row for row in self._by_head.get(word, ()) if len(self._words[row]) > 1]
        kinds = sum(self._is_kind(self._entries[row], entry) for row in others)
        return kinds + 1 >= _SAME_SENSE * len(others)

    def _is_kind(self, kind: int, entry: int) -> bool:
        while kind not in (entry, -1):
            kind = self._parents[kind] if self._parents else -1
        return kind == entry

    def _by_corrections(self, typed: Sequence[str]) -> LookUp | None:
        """Return the one entry that the phrase names with few enough misspellings, or None."""
        costs: dict[int, int] = {}
        for spelling, cost in self._spellings(typed):
            entry = self._by_key.get("".join(spelling))
            if entry is not None:
                costs[entry] = min(cost, costs.get(entry, cost))
        if not costs:
            return None
        letters = len("".join(typed))
        entry, cost = min(costs.items(), key=lambda item: item[::-1])
        margin = _MARGIN if cost and letters >= _LONG else 0
        others = [
            other for other, more in costs.items() if other != entry and more <= cost + margin
        ]
        if any(other < _RARER * (entry + 1) for other in others):
            return None
        return LookUp(entry, round(1 - cost / letters, 3), "spelling")

    def _spellings(self, typed: Sequence[str]) -> Iterator[tuple[list[str], int]]:
        """Yield the spellings of a phrase that need few enough edits, and their costs."""
        words = [singular(word) for word in typed]
        yield words, 0
        misspelt = [
            word not in self._entry_words and not any(map(word_vectors().knows, (word, plural)))
            for word, plural in zip(words, typed, strict=True)
        ]
        if sum(misspelt) > _MOST_MISSPELT:
            return
        if any(misspelt):
            corrections = [
                self._corrections({word, plural}, len(words) > 1) if is_misspelt else [(word, 0)]
                for word, plural, is_misspelt in zip(words, typed, misspelt, strict=True)
            ]
            for spelling in itertools.product(*corrections):
                yield [word for word, _ in spelling], sum(cost for _, cost in spelling)
        elif 1 < len(words) <= _MOST_ENGLISH:
            for k, word in enumerate(words):
                for other in self._alike({word}, 1) if word not in self._entry_words else ():
                    phrase = [*words[:k], other, *words[k + 1 :]]
                    if other[0] == word[0] and tuple(phrase) in self._phrases:
                        yield phrase, 1

    def _corrections(self, forms: set[str], is_in_phrase: bool) -> list[tuple[str, int]]:
        """Return at most `_MOST_CORRECTIONS` pairs (word of the lexicon, cost), cheapest first.

        The forms are a misspelt word and its singular.
        """
        letters = min(map(len, forms))
        edits = max(1, 3 * letters // 8)
        costs = {
            other: min(_cost(form, other) for form in forms) for other in self._alike(forms, edits)
        }
        # The other words of a phrase confirm a correction.
        most = 1 + (letters > 5) + (letters > 9) + is_in_phrase
        allowed = sorted(
            (cost, other)
            for other, cost in costs.items()
            if cost <= (most if other in self._entry_words else _MOST_JOINED)
        )
        return [(other, cost) for cost, other in allowed[:_MOST_CORRECTIONS]]

    def _alike(self, forms: set[str], most_edits: int) -> set[str]:
        """Return the words of the lexicon within a few edits of forms of a word."""
        found: set[str] = set()
        for form in forms:
            if len(form) >= _SHORTEST:
                lengths = range(len(form) - most_edits, len(form) + most_edits + 1)
                words = [word for length in lengths for word in self._lexicon.get(length, ())]
                matches = process.extract(
                    form, words, scorer=OSA.distance, limit=None, score_cutoff=most_edits
                )
                found.update(word for word, _, _ in matches)
        return found

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
        for similar_key, similarity, row in _similar(key, self._keys):
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
    matches = _similar(name[:LONGEST], [other[:LONGEST] for other in names], 3)
    return [names[row] for _, _, row in matches]


def _similar(
    name: str, names: Sequence[str], limit: int | None = None
) -> list[tuple[str, float, int]]:
    """Return triples (similar name, similarity, index of the name), most similar first."""
    similarity = OSA.normalized_similarity
    return process.extract(name, names, scorer=similarity, limit=limit, score_cutoff=_LEAST)


def _cost(typed: str, word: str) -> int:
    ends = _BY_FIRST * (typed[0] != word[0]) + _BY_LAST * (typed[-1] != word[-1])
    return OSA.distance(typed, word) + ends
