"""The layout of the relation units r of a machine.

A relation unit e = (a, i, j) is 1 if object class i has the canonical relation a to object class j.
A·V² units are too many to allocate, so `Edges` lists units in one row for each scene. Units that
the row of a scene does not list are 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class SceneRelations:
    """The relations between the n present classes of each of B scenes."""

    classes: Int[Tensor, "B n"]  # present classes; padding is -1
    counts: Int[Tensor, "B n"]  # instances of each of `classes`; 0: the source gives none
    holds: Float[Tensor, "B A n n"]  # value of each relation between two of `classes`
    observed: Bool[Tensor, "B A n n"]  # True where a relation is annotated


@dataclass(frozen=True)
class Edges:
    """The relation units (a, i, j) of B scenes. A single row applies to all scenes."""

    relation: Int[Tensor, "B E"]
    subject: Int[Tensor, "B E"]
    object: Int[Tensor, "B E"]
    valid: Bool[Tensor, "B E"]  # False marks padding; padded units are 0


@dataclass(frozen=True)
class PairEdges(Edges):
    """All A·n² units between the n classes of each scene, as flattened tables (A, n, n)."""

    classes: Int[Tensor, "B n"]  # padding is 0
    log_counts: Float[Tensor, "B n"]  # log of the number of instances of each class

    def unflatten(self, values: Float[Tensor, "... E"]) -> Float[Tensor, "... A n n"]:
        """Reshape values of the units into a table of relations, subjects and objects."""
        n = self.classes.shape[1]
        return values.reshape(*values.shape[:-1], -1, n, n)


def pair_edges(
    classes: Int[Tensor, "B n"], relations: int, log_counts: Float[Tensor, "B n"] | None = None
) -> PairEdges:
    """Return the units between the classes (-1: padding), by default with one instance of each."""
    B, n = classes.shape  # scenes, and classes of the largest scene
    exists, classes = classes >= 0, classes.clamp(min=0)
    subject, object_ = classes[:, None, :, None], classes[:, None, None, :]
    valid = (exists.unsqueeze(-1) & exists.unsqueeze(-2)).unsqueeze(1)
    relation = torch.arange(relations)[:, None, None]
    relation, subject, object_, valid = (
        values.expand(B, relations, n, n).flatten(1)
        for values in (relation, subject, object_, valid)
    )
    log_counts = torch.zeros(B, n) if log_counts is None else log_counts
    return PairEdges(relation, subject, object_, valid, classes, log_counts)


LaidOut = tuple[Edges, Float[Tensor, "B E"], Bool[Tensor, "B E"]]
"""The relation units of B scenes, their values r, and which of these are observed."""


def triple_edges(triples: Int[Tensor, "T 3"]) -> Edges:
    """Return the units of a table of triples (a, i, j), which apply to all scenes."""
    relation, subject, object_ = triples.long().T.unsqueeze(1).unbind(0)
    return Edges(relation, subject, object_, torch.ones_like(subject, dtype=torch.bool))


def triple_keys(
    relation: Int[Tensor, "*E"], subject: Int[Tensor, "*E"], object_: Int[Tensor, "*E"], V: int
) -> Int[Tensor, "*E"]:
    """Return one key for each unit. The keys have the same order as the triples (a, i, j)."""
    return (relation * V + subject) * V + object_


def find_triples(
    table: Int[Tensor, "T"], keys: Int[Tensor, "*E"]
) -> tuple[Int[Tensor, "*E"], Bool[Tensor, "*E"]]:
    """Return the index of each key in a sorted table, and True where the table has the key."""
    if not table.numel():
        return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
    position = torch.searchsorted(table, keys.contiguous()).clamp(max=table.numel() - 1)
    return position, table[position] == keys
