"""Read placing priors: tables of the usual relations between pairs of objects, without scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from app.scene import RELATIONS, label_key
from training.datasets.records import AnnotatedObject, AnnotatedScene
from training.datasets.tables import Errors, read_table

COLUMNS: Final = ("source", "subject", "relation", "object", "count", "room")

SOURCE: Final = "placing_priors"
"""Source name of all scenes that the reader makes from rows of the table."""

# Sources whose rows become training scenes: the places of VirtualHome and AI2-THOR.
_TRAINED: Final = ("virtualhome_placing", "ithor_receptacles")
# Other values of the column ``source``, such as tables of votes and of part counts.
_SKIPPED: Final = ("tidybot", "conceptnet_atlocation", "housekeep_votes", "vg80k_partof_counts")


def read_prior_scenes(path: Path) -> list[AnnotatedScene]:
    """Read each row of a list of places as a scene of two objects. Rows of a pair are one group."""
    scenes, errors = [], Errors(path)
    for row in read_table(path, COLUMNS, errors):
        with errors:
            source = row.one_of("source", (*_TRAINED, *_SKIPPED))
            relation = row.optional("relation")
            # One of the sources has prefixes, for example in "food bread" and "clothes skirt".
            names = [
                row.optional(column).removeprefix("food ").removeprefix("clothes ").strip()
                for column in ("subject", "object")
            ]
            keys = set(map(label_key, names)) - {""}
            if source in _TRAINED and relation in RELATIONS and len(keys) == 2:
                things = tuple(AnnotatedObject(str(k), name) for k, name in enumerate(names))
                group, listed = " ".join(names), ((0, relation, 1),)
                scenes.append(
                    AnnotatedScene(row.position, SOURCE, group, None, things, relations=listed)
                )
    errors.check()
    return scenes
