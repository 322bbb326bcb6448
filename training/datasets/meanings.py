"""The meaning of unlisted relations and of object lists, source by source.

A listed relation holds. An unlisted one is off, or off only for neighbours, or unobserved:

| source | on-top | above | left, front |
|---|---|---|---|
| boxes with sizes (procthor) | off | off | off for neighbours |
| centres only (bedrooms) | unobserved | unobserved | off |
| 3dssg | off | unobserved | off for neighbours |
| pictures and sentences | unobserved | unobserved | unobserved |
| lists of the user's own | off | off | off |

Two rules hold in every source. A listed on-top or above excludes all other relations of its pair,
in both directions, unless they are listed too: what stands on a thing is not beside it. (Of pairs
with a listed on-top or above, 1 to 10 % also have a left or front.) A relation that an annotator
denied is off.

Neighbours are near by the rule of `app.scene.geometry`. Without poses, neighbours are the pairs for
which the annotators listed any relation. 3DSSG compares heights only within a class and lists
left and front only between things with one support, so above and far pairs stay unobserved there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from app.scene import CANONICAL

Unlisted = Literal["off", "off for neighbours", "unobserved"]


@dataclass(frozen=True, slots=True)
class Meaning:
    """The meaning of the unlisted in a source.

    Attributes:
        on_top, above, lateral: an unlisted relation of the kind; left and front are lateral.
        complete_objects: the object list is nearly the whole scene, so that absence from it teaches
            which objects go together.
        scenes_per_group: a group counts as so many scenes at most in object learning; None where
            each scene counts in full.
    """

    on_top: Unlisted = "off"
    above: Unlisted = "off"
    lateral: Unlisted = "off"
    complete_objects: bool = True
    scenes_per_group: float | None = None

    @property
    def unlisted(self) -> tuple[Unlisted, ...]:
        """By canonical relation."""
        own = {"on-top": self.on_top, "above": self.above}
        return tuple(own.get(name, self.lateral) for name in CANONICAL)


LISTS: Final = Meaning()
"""Relations that a user listed: an unlisted one is off."""

BOXES: Final = Meaning(lateral="off for neighbours")
"""Relations derived from positions; without sizes the vertical ones are unobserved."""

_CENTRES: Final = Meaning(on_top="unobserved", above="unobserved")
_MENTIONS: Final = Meaning(
    on_top="unobserved", above="unobserved", lateral="unobserved", complete_objects=False
)

MEANINGS: Final[dict[str, Meaning]] = {
    "sunrgbd": LISTS,  # lists no relation at all
    "sunrgbd_bedrooms_3d": _CENTRES,
    "sunrgbd-bedroom-3d": _CENTRES,
    "3dssg": Meaning(above="unobserved", lateral="off for neighbours"),
    "procthor": BOXES,
    "vrd": _MENTIONS,
    "nr3d": _MENTIONS,
    "coco_captions": _MENTIONS,
    "reverie_text": _MENTIONS,
    "vsr": _MENTIONS,
    "bddl_goal": _MENTIONS,
    "placing_priors": _MENTIONS,
    # Thousands of episodes in about a hundred rooms: a room counts as a few scenes.
    "alfred": Meaning(
        on_top="unobserved", above="unobserved", lateral="unobserved", scenes_per_group=3.0
    ),
    "behavior1k_rooms": LISTS,  # lists no relation at all
}


def meaning_of(source: str, *, listed: bool = True) -> Meaning:
    """The meaning of a source; of an unknown one by whether its scenes list relations."""
    return MEANINGS.get(source, LISTS if listed else BOXES)
