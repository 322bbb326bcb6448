"""The posterior of a scene with given relations, from one set of compiled draws.

For the machines that have a closed form without them.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from app.boltzmann.closed_form import ClosedForm
from app.boltzmann.given_relations import (
    GivenDraws,
    Pairs,
    candidate_log_odds,
    log_odds,
    weights,
)
from app.reasoning.present import present
from app.registry.artifact import Artifact
from app.scene.evidence import class_evidence
from app.scene.scene import Scene

Floats = NDArray[np.float32]
Places = NDArray[np.int64]


class WeighedPosterior:
    """See `Posterior`, and `app/boltzmann/given_relations.py` for the formulas."""

    def __init__(self, artifact: Artifact, closed: ClosedForm, scene: Scene) -> None:
        machine = artifact.machine
        A = machine.spec.A
        self.present = present(scene, machine.spec)
        self._artifact, self._closed = artifact, closed
        self._presence = self.present.presence.astype(np.float32)
        self._log_counts = np.log(self.present.counts).astype(np.float32)
        classes = self.present.classes
        x = closed.hidden_logits(classes, self._presence, scene.room_type)
        found = class_evidence(scene)
        holds, observed = found.holds[:A], found.observed[:A]
        # Only pairs that something is known of, (E,) places each.
        self._subject, self._object = np.nonzero(observed.any(0))
        self._pairs = self._pairs_of(self._subject, self._object)
        given = observed[:, self._subject, self._object]
        both = self._presence[self._subject] * self._presence[self._object]
        holding = given & holds[:, self._subject, self._object]
        self._r = holding.astype(np.float32, order="C")
        self._gate = np.ascontiguousarray(given * both)
        self._draws = GivenDraws(closed, x, self._pairs, self._r, self._gate)
        self._weight = weights(self._draws.log_weight)
        self._observed, self._holds = observed, holds & observed

    def absent_log_odds(self, absent: Places) -> Floats:
        """b_i + G_i + log E_w[exp(W_i·h1)] - log mean exp(W_i·h1), G_i under the proposal: a control
        that takes out what both estimates err in common.
        """
        bare = self._draws.h @ self._closed.W[absent].T
        return self._closed.b[absent] + self._corrected(bare, absent)

    def _corrected(self, bare: Floats, absent: Places) -> Floats:
        closed = self._artifact.scorer.row_gain(self._draws.y)[absent]
        ratio = np.exp(np.clip(bare - closed, -80.0, 80.0))
        found: Floats = closed + np.log(self._weight @ ratio) - np.log(ratio.mean(0))
        return found

    def relation_log_odds(self) -> Floats:
        """Each given unit is taken out of the weights for itself."""
        n = len(self.present.classes)
        subject, object_ = np.divmod(np.arange(n * n), n)
        pairs = self._pairs_of(subject, object_)
        logits = self._draws.logits(pairs)
        flat = self._subject * n + self._object
        gate, terms = np.zeros(pairs.base.shape, np.float32), np.zeros_like(logits)
        gate[:, flat], terms[:, :, flat] = self._gate, self._draws.terms
        found = log_odds(logits, self._weight, self._implied(), terms, gate)
        return found.reshape(-1, n, n)

    def _implied(self) -> Floats:
        """What the relations that hold imply for the others, (A, n²)."""
        machine = self._artifact.machine
        A, n, _ = self._holds.shape
        if not machine.spec.G:
            return np.zeros((A, n * n), dtype=np.float32)
        edges = machine.edges(torch.from_numpy(self.present.classes).unsqueeze(0))
        given = torch.from_numpy(self._holds.astype(np.float32)).flatten().unsqueeze(0)
        mean = torch.from_numpy(self._draws.x).sigmoid().unsqueeze(0)
        with torch.inference_mode():
            found: Floats = machine.implied(edges, given, mean)[0].numpy()
        return found.reshape(A, n * n)

    def placement_log_odds(self, candidates: Places, anchors: Places) -> tuple[Floats, Floats]:
        """Over draws weighed as if the candidate were there."""
        N, m = len(candidates), len(anchors)
        weight = self._weights_with(candidates)
        classes, counts = self.present.classes[anchors], self._log_counts[anchors]
        candidate, anchor = np.repeat(candidates, m), np.tile(classes, N)
        one, count = np.zeros(N * m, dtype=np.float32), np.tile(counts, N)
        found = []
        for pairs in (
            Pairs(self._closed, candidate, anchor, one, count),
            Pairs(self._closed, anchor, candidate, count, one),
        ):
            logits = self._draws.logits(pairs)
            values = candidate_log_odds(logits.reshape(*logits.shape[:2], N, m), weight)
            found.append(values.transpose(1, 0, 2))
        return found[0], found[1]

    def placed_log_p(
        self, candidates: Places, relation: int, anchor: int, *, outgoing: bool
    ) -> Floats:
        """Over draws weighed as if the candidate were there."""
        N = len(candidates)
        weight = self._weights_with(candidates)
        other = np.full(N, self.present.classes[anchor])
        one, count = np.zeros(N, np.float32), np.full(N, self._log_counts[anchor])
        if outgoing:
            pairs = Pairs(self._closed, candidates, other, one, count)
        else:
            pairs = Pairs(self._closed, other, candidates, count, one)
        logits = self._draws.logits(pairs)[:, relation : relation + 1, :, None]
        values = candidate_log_odds(np.ascontiguousarray(logits), weight)[0, :, 0]
        return -np.logaddexp(np.float32(0.0), -values)

    def _weights_with(self, candidates: Places) -> Floats:
        """Of the draws, were each candidate there, (M, N)."""
        bare = self._draws.h @ self._closed.W[candidates].T
        return weights(self._draws.log_weight[:, None] + bare)

    def log_odds_given_rest(self) -> Floats:
        """From the same draws, the class and its relations taken out of their weights.

            b_i + G_i + log E_w[exp(W_i·h1)] - log E_q[exp(W_i·h1)]

        with both weights of draws from the whole scene: w for p(h1 | rest), q for the mean field of
        the rest, under which G_i is in closed form.
        """
        draws, W = self._draws, self._closed.W[self.present.classes]
        share, _ = self._shares()
        gain, _ = self._leave_one_out(np.zeros(0, dtype=np.int64))
        bare = draws.h @ W.T
        # (M, n): the terms of the relations that touch a class.
        touching = np.stack([draws.terms[:, :, t].sum((1, 2)) for t in self._touching()], axis=1)
        rest = draws.log_weight[:, None] - self._presence * bare - touching
        proposal = -(draws.h @ share.T)
        exact = _log_mean_exp(bare, rest) - _log_mean_exp(bare, proposal)
        found: Floats = self._closed.b[self.present.classes] + gain + exact
        return found

    def reasons(self, rows: Places) -> Floats:
        """At the mean field of the whole scene, each part of it held as it is there."""
        alone, pairs = self._leave_one_out(rows)
        change = alone[rows, None] - pairs
        change[np.arange(len(rows)), rows] = 0.0
        return change

    def _touching(self) -> list[Places]:
        """For each class, the pairs it is in."""
        return [
            np.flatnonzero((self._subject == i) | (self._object == i))
            for i in range(len(self.present.classes))
        ]

    def _shares(self) -> tuple[Floats, Floats]:
        """What each class and its relations add to y, (n, H1); the relations' part of it."""
        n, (A, E) = len(self.present.classes), self._gate.shape
        mask = np.zeros((n, A, E), dtype=np.float32)
        for i, touched in enumerate(self._touching()):
            mask[i][:, touched] = 1.0
        pulls = self._draws.pulls(self._pairs, mask)
        own = self._presence[:, None] * self._closed.W[self.present.classes]
        return own + pulls, pulls

    def _leave_one_out(self, rows: Places) -> tuple[Floats, Floats]:
        share, _ = self._shares()
        n, (A, E) = len(share), self._gate.shape
        common = None
        if len(rows):
            # What two classes add together goes out with either, so it must not go out twice.
            mask = np.zeros((len(rows), n, A, E), dtype=np.float32)
            for c, i in enumerate(rows):
                for e in np.flatnonzero((self._subject == i) != (self._object == i)):
                    other = self._object[e] if self._subject[e] == i else self._subject[e]
                    mask[c, other, :, e] = 1.0
            pulls = self._draws.pulls(self._pairs, mask.reshape(-1, A, E))
            common = pulls.reshape(len(rows), n, -1)
        return self._closed.leave_one_out(
            self._draws.y, self.present.classes, share, rows, common
        )

    def _pairs_of(self, subject: Places, object_: Places) -> Pairs:
        classes, counts = self.present.classes, self._log_counts
        return Pairs(
            self._closed, classes[subject], classes[object_], counts[subject], counts[object_]
        )


def _log_mean_exp(values: Floats, log_weight: Floats) -> Floats:
    """log of the weighted mean of e^values over the first axis, (M, n) both."""
    total = values + log_weight
    top, bottom = total.max(0), log_weight.max(0)
    found: Floats = (
        top
        - bottom
        + np.log(np.exp(total - top).sum(0))
        - np.log(np.exp(log_weight - bottom).sum(0))
    )
    return found
