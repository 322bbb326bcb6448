"""Where what was observed and what the rest of the scene makes one expect disagree.

A pair of objects of which some relation holds is judged once more as if nothing were known of how
the two stand: with every relation between their classes unobserved, on or off, in both directions.
Otherwise the observation would speak for itself: left holds, so front was seen not to. If the
likeliest of the eight relations is then none of the observed ones, and likelier than not, the two
disagree.

Units are those of classes. So where classes have several instances, what any pair of these shows
counts as observed: one chair to the left and one to the right of the table are as expected as the
other way round, whichever of the two is likelier.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import Disagreement
from app.reasoning.listing import disagreeing, observed_pairs
from app.reasoning.posterior import Posterior
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, OPPOSITES
from app.scene.scene import Scene

EXPECTED = 0.5
"""From this probability on a relation is expected: likelier than not.

Of two relations that are both unlikely, the likelier one says little.
"""


def disagreements(
    artifact: Artifact,
    scene: Scene,
    given: Posterior,
    asked: NDArray[np.bool_],
    *,
    top_k: int,
    min_probability: float,
) -> tuple[Disagreement, ...]:
    """The pairs of which another relation than any observed one is expected, largest ratio first.

    Ties go by position. Each is spelled from the subject of its first observed relation, in the
    order of `CANONICAL`. A relation that the machine has no unit for is never expected.

    Args:
        given: the posterior of the scene.
        asked: (N, N) ordered pairs; a pair asked either way counts.
        top_k: at most so many.
        min_probability: leave out what is expected with less.
    """
    A = artifact.spec.A
    stated = [triple for triple in scene.relations or () if triple[0] < A]
    if not stated:
        return ()
    present = given.present
    subjects, objects, holds, of_classes = observed_pairs(
        np.array(stated), present.row, asked, len(present.classes), A
    )
    if not len(subjects):
        return ()
    one, other = present.row[subjects], present.row[objects]
    where, *found = disagreeing(
        *(artifact.relation_slopes.given, *given.log_odds_apart(one, other)),
        *(present.log_counts[one] + present.log_counts[other], len(present.classes)),
        *(holds, of_classes, max(min_probability, EXPECTED), top_k),
    )
    pairs = subjects[where], objects[where], holds[where]
    names = CANONICAL[:A] + tuple(OPPOSITES[name] for name in CANONICAL[:A])
    return tuple(
        [
            Disagreement(
                subject,
                object_,
                tuple([name for bit, name in enumerate(names) if held >> bit & 1]),
                names[expected],
                probability,
                observed,
            )
            for subject, object_, held, expected, probability, observed in zip(
                *(values.tolist() for values in (*pairs, *found)), strict=True
            )
        ]
    )
