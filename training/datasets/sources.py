"""Known data sources: terms of use, predicates, and the meaning of relations that are not listed.

A listed relation holds. An unlisted relation is false ("off"), false only between neighbours ("off
for neighbours"), false only if the support of its subject is listed ("off for supported"), or
unobserved. docs/decisions/relations.md gives the reason for each source.

Two rules apply to every data source. First, if on-top, inside or above is listed for a pair of
objects, all unlisted relations of the pair are false in both directions. (1 to 10 % of such pairs
also have a listed left or front.) Second, a relation that an annotator marked as false is false.

With poses, two objects are neighbours if they are close by the rule of `app.scene.geometry`.
Without poses, two objects with at least one listed relation are neighbours. 3DSSG compares heights
only within a class, so an unlisted above is unobserved. It lists left and front only between
objects on the same support.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

from app.scene import CANONICAL, RELATIONS

Unlisted = Literal["off", "off for neighbours", "off for supported", "unobserved"]


@dataclass(frozen=True, slots=True)
class Meaning:
    """The meaning of relations and objects that the scenes of a data source do not list."""

    on_top: Unlisted = "off"
    inside: Unlisted = "off"
    above: Unlisted = "off"
    lateral: Unlisted = "off"  # left and front
    # Object lists are nearly complete: in the training of objects, unlisted objects are absent.
    complete_objects: bool = True
    # Maximum total weight of a group of near-duplicates in the training of objects, in scenes. The
    # scenes of all data sources count. None means that each scene has weight 1.
    scenes_per_group: float | None = None

    @property
    def unlisted(self) -> tuple[Unlisted, ...]:
        """Meaning of an unlisted relation, for each canonical relation in order."""
        stacked = {"on-top": self.on_top, "above": self.above, "inside": self.inside}
        return tuple(stacked.get(name, self.lateral) for name in CANONICAL)


LISTS: Final = Meaning()
"""Meaning for scenes of the user with listed relations: an unlisted relation is false."""

BOXES: Final = Meaning(lateral="off for neighbours")
"""Meaning for relations derived from boxes. Without sizes, stacked objects show no relation."""

_CENTRES: Final = Meaning(on_top="unobserved", inside="unobserved", above="unobserved")
_SELECTED: Final = replace(_CENTRES, lateral="unobserved")
_SUPPORTS: Final = replace(_SELECTED, on_top="off", inside="off")
_MENTIONS: Final = replace(_SELECTED, complete_objects=False)
# Several data sources annotate the same photographs of COCO, so a photograph has the weight of one
# scene.
_PHOTOGRAPHS: Final = replace(_MENTIONS, scenes_per_group=1.0)

# Photographers aim at people and pets. So photographs show them far more often than rooms contain
# them.
_AIMED_AT: Final = ("person", "cat", "dog", "bird", "animal")

# Relation of each predicate of 3DSSG. All kinds of support become on-top or inside.
_3DSSG: Final = {
    **dict.fromkeys(("standing on", "lying on", "supported by"), "on-top"),
    **dict.fromkeys(("standing in", "lying in", "hanging in"), "inside"),
    "higher than": "above",
    "lower than": "below",
}
_VRD: Final = {
    "on": "on-top",
    "on the top of": "on-top",
    "over": "above",
    "beneath": "under",
    "in": "inside",
    "in the front of": "front",
    "on the left of": "left",
    "on the right of": "right",
}


@dataclass(frozen=True, slots=True)
class Source:
    """A known data source."""

    terms: str  # origin and licence of the data, for the model card
    research_only: bool = False  # the licence excludes commercial use
    # None means `LISTS` for scenes with listed relations, and `BOXES` for other scenes.
    meaning: Meaning | None = None
    # Relations of the predicates that are no names of relations. The reader skips other predicates,
    # such as "next to". None means that another predicate is an error.
    predicates: Mapping[str, str] | None = None
    supports: tuple[str, ...] = ()  # predicates that state the support of their subject
    left_out: tuple[str, ...] = ()  # labels whose annotation is too incomplete or biased
    # Classes whose objects annotators mostly call by the name of the broader class, such as "table"
    # for a coffee table. An unlisted class of this kind is unobserved.
    coarse: tuple[str, ...] = ()
    # Annotators used free words, so an unlisted class is absent. Otherwise a class outside their
    # list of labels is unobserved.
    open_vocabulary: bool = False
    counts_movables: bool = False  # only movable objects are counted, others occur once in a scene
    # A scene is one camera frame, which does not show how many objects are in the room. So
    # statistics of counts do not learn from it.
    of_one_view: bool = False
    # Numbers of instances are the judgements of a writer, so statistics of counts leave them out.
    written: bool = False
    # A scene lists nearly all things of a whole room, as people furnish it. Scenes drawn for
    # `/generate` are compared with such rooms.
    whole_rooms: bool = False


_BEDROOMS: Final = Source(
    "SUN RGB-D (Song, Lichtenberg, Xiao, CVPR 2015): 3D boxes of real bedrooms; research use",
    research_only=True,
    meaning=_CENTRES,
    of_one_view=True,
)

SOURCES: Final[dict[str, Source]] = {
    "sunrgbd": Source(
        "SUN RGB-D (Song, Lichtenberg, Xiao, CVPR 2015): object labels and scene types of real "
        "RGB-D frames; research use",
        research_only=True,
        meaning=LISTS,  # its scenes list no relations
        left_out=("wall", "floor"),
        # Their share of all tables, chairs, lamps and clothes is less than a tenth of that in other
        # sources.
        coarse=(
            *("coffee table", "side table", "console table", "armchair", "computer chair"),
            *("floor lamp", "shirt", "pants", "jacket"),
        ),
        open_vocabulary=True,
        of_one_view=True,
    ),
    "sunrgbd_bedrooms_3d": _BEDROOMS,
    "sunrgbd-bedroom-3d": _BEDROOMS,  # source name inside the file
    "3dssg": Source(
        "3DSSG (Wald, Dhamo, Navab, Tombari, CVPR 2020) on 3RScan: annotated relations of real "
        "rooms; research use",
        research_only=True,
        meaning=Meaning(
            on_top="off for supported",
            inside="off for supported",
            above="unobserved",
            lateral="off for neighbours",
        ),
        predicates=_3DSSG,
        supports=(
            *("standing on", "lying on", "supported by", "standing in", "lying in", "hanging in"),
            *("hanging on", "attached to", "leaning against", "build in", "connected to"),
            *("part of", "belonging to"),
        ),
        whole_rooms=True,
    ),
    "procthor": Source(
        "ProcTHOR (Deitke et al., NeurIPS 2022): procedural rooms; Apache-2.0",
        meaning=BOXES,
        coarse=("coffee table",),
    ),
    "vrd": Source(
        "VRD (Lu, Krishna, Bernstein, Fei-Fei, ECCV 2016): annotated relations in photographs; "
        "research use",
        research_only=True,
        meaning=_MENTIONS,
        predicates=_VRD,
    ),
    "nr3d": Source(
        "Nr3D (Achlioptas et al., ECCV 2020): triples from descriptions of ScanNet rooms; "
        "research use",
        research_only=True,
        meaning=_MENTIONS,
        predicates={},
    ),
    "coco_captions": Source(
        "COCO captions (Lin et al., ECCV 2014; COCO Consortium): triples from captions of indoor "
        "pictures; CC BY 4.0, with attribution",
        meaning=_PHOTOGRAPHS,
        left_out=_AIMED_AT,
        predicates={},
    ),
    "coco_captions_2014": Source(
        "COCO captions (Lin et al., ECCV 2014; COCO Consortium) and VQA v2 (Goyal et al., CVPR "
        "2017): objects and triples from sentences about pictures of 2014; CC BY 4.0, with "
        "attribution",
        meaning=_PHOTOGRAPHS,
        left_out=_AIMED_AT,
        predicates={},
    ),
    "coco_labels": Source(
        "COCO (Lin et al., ECCV 2014; COCO Consortium): annotated classes of pictures; CC BY 4.0, "
        "with attribution",
        # Its scenes list no relations. Its annotators looked for 80 classes alone.
        meaning=replace(LISTS, scenes_per_group=1.0),
        left_out=_AIMED_AT,
        predicates={},
        of_one_view=True,
    ),
    "vg_vlchecklist": Source(
        "Visual Genome (Krishna et al., IJCV 2017), changed: objects and triples of photographs "
        "from statements of VL-CheckList (Zhao et al., EMNLP 2022); CC BY 4.0, with attribution",
        meaning=_MENTIONS,
        left_out=(*_AIMED_AT, "man", "woman"),
        predicates={},
    ),
    "amber": Source(
        "AMBER (Wang et al., 2023): objects of photographs; Apache-2.0",
        meaning=_MENTIONS,
        left_out=_AIMED_AT,
        predicates={},
    ),
    "robocasa": Source(
        "RoboCasa (Nasiriany et al., RSS 2024): designed kitchens with their objects; MIT",
        meaning=replace(_SUPPORTS, scenes_per_group=3.0),
        predicates={},
        whole_rooms=True,
    ),
    "twc": Source(
        "TextWorld Commonsense (Murugesan et al., AAAI 2021): where things belong; Apache-2.0",
        meaning=_MENTIONS,
        predicates={},
    ),
    "people_lists": Source(
        "ProtoQA (Boratko et al., EMNLP 2020) and lists in the public domain: what people name at "
        "a place; CC BY 4.0",
        meaning=replace(_MENTIONS, scenes_per_group=1.0),
        predicates={},
    ),
    "meetup_ade20k": Source(
        "MeetUp (Ilinykh, Zarrieß, Schlangen, 2019): dialogues about photographs of rooms; "
        "BSD-3-Clause",
        meaning=_MENTIONS,
        left_out=_AIMED_AT,
        predicates={},
    ),
    "virtualhome_programs": Source(
        "VirtualHome (Puig et al., CVPR 2018): things that people use together; MIT",
        meaning=replace(_MENTIONS, scenes_per_group=1.0),
        predicates={},
    ),
    "robot_worlds": Source(
        "Worlds of robot simulators (AWS RoboMaker, MIT-0; Open-RMF, Apache-2.0): hospitals, "
        "offices and an airport",
        meaning=replace(_MENTIONS, scenes_per_group=2.0),
        predicates={},
    ),
    "reverie_text": Source(
        "REVERIE (Qi et al., CVPR 2020): triples from instructions for Matterport houses; "
        "non-commercial use",
        research_only=True,
        meaning=_MENTIONS,
        predicates={},
    ),
    "alfred": Source(
        "ALFRED (Shridhar et al., CVPR 2020): AI2-THOR rooms and triples from instructions; MIT",
        # Thousands of episodes show only about a hundred rooms, so all episodes of a room together
        # have the weight of three scenes.
        meaning=replace(_SELECTED, scenes_per_group=3.0),
        predicates={},
        left_out=("steps",),  # of a person: "walk two steps"
        counts_movables=True,
    ),
    "bddl_goal": Source(
        "BEHAVIOR-1K (Li et al., CoRL 2022): end states of household activities; MIT",
        meaning=_MENTIONS,
        predicates={},
    ),
    "behavior1k_rooms": Source(
        "BEHAVIOR-1K (Li et al., CoRL 2022): object lists of rooms; MIT",
        meaning=LISTS,  # its scenes list no relations
        predicates={},
        whole_rooms=True,
    ),
    "matterport_rooms": Source(
        "Matterport3D (Chang et al., 3DV 2017): object lists of rooms, from REVERIE (Qi et al., "
        "CVPR 2020) and LAD (Li et al., AAAI 2023); non-commercial use",
        research_only=True,
        meaning=LISTS,  # its scenes list no relations
        left_out=("wall", "door"),
        whole_rooms=True,
    ),
    "virtualhome": Source(
        "VirtualHome (Puig et al., CVPR 2018): rooms of designed apartments; MIT",
        meaning=_SUPPORTS,
        predicates={},
        whole_rooms=True,
    ),
    "vsr": Source(
        "Visual Spatial Reasoning (Liu, Emerson, Collier, TACL 2023): voted relations in "
        "photographs; Apache-2.0",
        meaning=_PHOTOGRAPHS,
        predicates={},
    ),
    "placing_priors": Source(
        "VirtualHome (Puig et al., CVPR 2018) and AI2-THOR (Kolve et al., 2017): where things are "
        "placed; MIT and Apache-2.0",
        meaning=_MENTIONS,
    ),
    "rooms": Source("Rooms made by this project's own generator; no restriction", whole_rooms=True),
    "inventories": Source(
        "Inventories of places, written for this project from general knowledge; their shares are "
        "judgements; Apache-2.0",
        # Each thing has one stated stand, so it stands nowhere else.
        meaning=replace(_SELECTED, on_top="off for supported", inside="off for supported"),
        # Writers list what detectors do not name.
        left_out=(
            *("door", "window", "outlet", "light switch", "vent", "smoke detector", "sprinkler"),
            *("curtain rod", "windowsill", "baseboard"),
        ),
        open_vocabulary=True,
        written=True,
        whole_rooms=True,
    ),
}


_UNKNOWN: Final = Source("", whole_rooms=True)
_OWN_INVENTORY: Final = replace(SOURCES["inventories"], terms="", left_out=())


def is_inventory(name: str) -> bool:
    """Return True for the name of a written inventory: of a user's table, or of the repository's.

    The table of a user is a source that keeps the name of its file, such as "ward.csv".
    """
    return name == "inventories" or name.casefold().endswith(".csv")


def source_of(name: str) -> Source:
    """Return the data source of this name. Unknown sources have the default attributes."""
    return SOURCES.get(name, _OWN_INVENTORY if is_inventory(name) else _UNKNOWN)


def meaning_of(source: str, *, listed: bool = True) -> Meaning:
    """Return the meaning of relations and objects that a data source does not list.

    Args:
        listed: True if the scene lists relations. Only unknown sources, and sources without a fixed
            meaning, depend on this argument.
    """
    return source_of(source).meaning or (LISTS if listed else BOXES)


def relation_of(source: str, predicate: str) -> str | None:
    """Return the relation that a predicate of a data source means, or None if no relation matches.

    Raises:
        ValueError: the predicate is unknown, and the data source has no table of predicates.
    """
    if predicate in RELATIONS:
        return predicate
    if (predicates := source_of(source).predicates) is None:
        raise ValueError(f"unknown relation {predicate!r}: must be one of {', '.join(RELATIONS)}")
    return predicates.get(predicate)


def relations_of(
    source: str, triples: Iterable[tuple[int, str, int]]
) -> tuple[tuple[int, str, int], ...]:
    """Translate triples (subject, predicate, object) of a data source into distinct relations.

    Predicates that are no relation of the service are skipped. Some image annotators relate an
    object to itself. Such triples are also skipped.
    """
    relations = [(i, relation_of(source, predicate), j) for i, predicate, j in triples]
    return tuple(dict.fromkeys((i, name, j) for i, name, j in relations if name and i != j))


def supported_subjects(source: str, triples: Iterable[tuple[int, str, int]]) -> tuple[int, ...]:
    """Return the sorted subjects of triples (subject, predicate, object) that state a support."""
    supports = source_of(source).supports
    return tuple(sorted({subject for subject, predicate, _ in triples if predicate in supports}))
