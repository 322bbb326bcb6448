"""How often `unknown_labels: "nearest"` takes an unknown label for the right class.

Two kinds of unknown labels: every alias, removed from the vocabulary, and every name with one
random edit (a letter left out, doubled, replaced, or exchanged with the next one). A mapping is
right if it leads to the class that the name belongs to.

    python -m training.evaluation.nearest model_store/indoor-triway/2.0.0
"""

from __future__ import annotations

import string
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from app.registry.verified import read_verified
from app.scene.labels import label_key
from app.scene.nearest import ACCEPTED, NameIndex
from app.scene.vocabulary import Vocabulary


class Mapped(NamedTuple):
    """An unknown name: the similarity of its nearest class, and whether that is the right one."""

    similarity: float
    is_right: bool


def held_out_aliases(vocabulary: Vocabulary) -> list[Mapped]:
    """Every alias, looked up among the other names."""
    names = [
        (name, index)
        for index, entry in enumerate(vocabulary.objects)
        for name in (entry.label, *entry.aliases)
    ]
    found = []
    for index, entry in enumerate(vocabulary.objects):
        for alias in entry.aliases:
            others = [name for name in names if label_key(name[0]) != label_key(alias)]
            found.append(_mapped(NameIndex(others), alias, index))
    return found


def misspelt(vocabulary: Vocabulary, seed: int = 0) -> list[Mapped]:
    """Every name with one random edit that no class has as its name."""
    rng = np.random.default_rng(seed)
    index = NameIndex(
        [
            (name, place)
            for place, entry in enumerate(vocabulary.objects)
            for name in (entry.label, *entry.aliases)
        ]
    )
    found = []
    for place, entry in enumerate(vocabulary.objects):
        for name in (entry.label, *entry.aliases):
            wrong = _edited(name, rng)
            if vocabulary.index(wrong) is None:
                found.append(_mapped(index, wrong, place))
    return found


def precision(mapped: Sequence[Mapped], threshold: float) -> tuple[int, int]:
    """How many are accepted at a threshold, and how many of these are right."""
    accepted = [one for one in mapped if one.similarity >= threshold]
    return len(accepted), sum(one.is_right for one in accepted)


def _mapped(index: NameIndex, name: str, wanted: int) -> Mapped:
    matches = index.nearest(name, 1)
    if not matches:
        return Mapped(0.0, False)
    return Mapped(matches[0].similarity, matches[0].entry == wanted)


def _edited(name: str, rng: np.random.Generator) -> str:
    place = int(rng.integers(len(name) - 1)) if len(name) > 1 else 0
    before, letter, after = name[:place], name[place], name[place + 1 :]
    match int(rng.integers(4)):
        case 0:
            return before + after
        case 1:
            return before + letter + letter + after
        case 2:
            return before + str(rng.choice(list(string.ascii_lowercase))) + after
        case _:
            return before + after[:1] + letter + after[1:]


def main(artifact: Path) -> None:
    manifest = read_verified(artifact).manifest
    vocabulary = manifest.vocabulary.vocabulary()
    aliases, typos = held_out_aliases(vocabulary), misspelt(vocabulary)
    print(f"{len(aliases)} held-out aliases, {len(typos)} misspelt names; accepted, right:")
    for threshold in sorted({0.6, 0.7, 0.75, ACCEPTED, 0.85, 0.9}):
        parts = [precision(part, threshold) for part in (aliases, typos, aliases + typos)]
        text = "  ".join(f"{a:5} {r:5} {r / max(a, 1):6.1%}" for a, r in parts)
        print(f"{threshold:5.3f}  {text}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
