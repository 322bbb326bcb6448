"""Completion by logic: the frequency table, moved by what follows from the given relations.

What a chain of given a(i, j), a(j, k) leads to follows transitively and gets a bonus; the mirror
image a(k, i) of what is given or follows gets a penalty. (That right is left read from the other
end, the inverse closure, is built into the canonical relations.) Both are soft: between classes
with several instances neither rule is strict, and on-top is no order among annotated supports.

The score reads `holds` where `observed`, as GIVEN evidence: it must be handed a batch that marks
the given relations alone, as `training.evaluation.completion` does, never a scene's own annotation.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from training.baselines.fitting import Proposals
from training.baselines.frequency_table import smoothed_log_odds
from training.baselines.triple_counts import TripleTable, count_triples
from training.batches import Batch, SceneTensors
from training.evaluation.closure import transitive_closure
from training.evaluation.relations import RelationScore

_PAIR = (3.0, 10.0, 30.0)
_END = 30.0
_MULTIPLICITY = (0.5, 1.0)
_BONUS = (0.0, 1.0, 2.0, 4.0)
_PENALTY = (0.0, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class ClosureScore:
    """table + bonus · [follows] - penalty · [mirror of given or following].

    Attributes:
        table: log-odds without evidence.
        bonus, penalty: in log-odds, >= 0.
    """

    table: TripleTable
    bonus: float
    penalty: float

    def __call__(self, batch: Batch) -> Tensor:
        """Log-odds (B, A, n, n) given the observed relations of the batch."""
        given = (batch.holds > 0) & batch.observed
        closed = transitive_closure(given)
        follows, mirror = closed & ~given, closed.mT & ~closed
        return self.table(batch) + self.bonus * follows - self.penalty * mirror


def propose(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[RelationScore]:
    """Smoothing × weight of the counts × bonus × penalty."""
    counts = count_triples(train, structure)
    for pair in _PAIR:
        log_odds = smoothed_log_odds(counts, pair, _END)
        for weight in _MULTIPLICITY:
            table = TripleTable(log_odds, weight)
            for bonus in _BONUS:
                for penalty in _PENALTY:
                    parameters = {"pair": pair, "multiplicity": weight, "bonus": bonus}
                    yield parameters | {"penalty": penalty}, ClosureScore(table, bonus, penalty)
