"""kNN over scenes: what is in the training scenes most like this one.

    p(i) = (sum of the votes of the neighbours that have i + share of all scenes with i)
           / (sum of votes + 1),    scored as its logit

The nearest scene has one vote, the others a power of their cosine as a share of the nearest one's.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import embedding_bag, normalize

from training.baselines.fitting import Proposals
from training.baselines.popularity import frequency
from training.batches import SceneTensors
from training.evaluation.missing import ObjectScore

_NEIGHBOURS = (100, 200)
_SHARPNESS = (2.0, 4.0, 8.0, 12.0)


def nearest_score(v: Tensor, *, neighbours: int, sharpness: float) -> ObjectScore:
    """Log-odds (B, V) of presence (B, V).

    Args:
        v: (N, V) training scenes.
        neighbours: k.
        sharpness: power of a cosine, relative to the nearest's, in a vote.
    """
    popularity = frequency(v)
    index = normalize(v, dim=1).T.contiguous()

    def score(query: Tensor) -> Tensor:
        cosine = normalize(query, dim=1) @ index
        near, place = cosine.topk(min(neighbours, len(v)), dim=1)
        # A scene that shares nothing has no vote, nor has any for an empty query.
        vote = (near / near[:, :1].clamp(min=1e-6)) ** sharpness
        share = embedding_bag(place, v, per_sample_weights=vote, mode="sum") + popularity
        return (share / (vote.sum(1, keepdim=True) + 1.0)).logit()

    return score


def propose(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[ObjectScore]:
    """Neighbours × powers of their cosines."""
    for k in _NEIGHBOURS:
        for power in _SHARPNESS:
            score = nearest_score(train.v, neighbours=k, sharpness=power)
            yield {"neighbours": k, "sharpness": power}, score
