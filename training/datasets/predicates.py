"""Annotated predicates to the eight relations, source by source.

The sources of sentences (`SENTENCES`) use the names of the eight and these, which are left out:

- ``inside``, ``contains``: a cup in a cupboard is not on top of it;
- ``attached``: a towel on a hook, a picture on a wall;
- ``next to``, ``touching``: they have no direction;
- ``covered``: the dust on a table is a state of the table.
"""

from __future__ import annotations

from typing import Final

from app.scene import RELATIONS

_THE_EIGHT = {name: name for name in RELATIONS}

# Supports of 3DSSG (Wald et al., CVPR 2020) are one relation here, however the thing rests.
_3DSSG = {
    "left": "left",
    "right": "right",
    "front": "front",
    "behind": "behind",
    "standing on": "on-top",
    "lying on": "on-top",
    "supported by": "on-top",
    "higher than": "above",
    "lower than": "below",
}

_VRD = {
    "on": "on-top",
    "on the top of": "on-top",
    "above": "above",
    "over": "above",
    "under": "under",
    "beneath": "under",
    "below": "below",
    "behind": "behind",
    "in the front of": "front",
    "on the left of": "left",
    "on the right of": "right",
}

SENTENCES: Final = (
    "alfred", "bddl_goal", "behavior1k_rooms", "coco_captions", "nr3d", "reverie_text", "vsr",
)  # fmt: skip

# Sources whose other predicates (wear, close by, bigger than) are known and say nothing spatial
# that the eight relations could hold. Anywhere else an unknown predicate is a mistake.
_OPEN: Final[dict[str, dict[str, str]]] = {
    "3dssg": _3DSSG,
    "vrd": _VRD,
    **dict.fromkeys(SENTENCES, _THE_EIGHT),
}


def relation_of(source: str, predicate: str) -> str | None:
    """One of the eight relations, or None where a predicate of the source is none of them.

    Raises:
        ValueError: none of the eight, in a source that has no predicates of its own.
    """
    if (table := _OPEN.get(source)) is not None:
        return table.get(predicate)
    if predicate not in _THE_EIGHT:
        raise ValueError(f"unknown relation {predicate!r}: must be one of {', '.join(RELATIONS)}")
    return predicate
