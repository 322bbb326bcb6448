"""The model that answers: a trained machine, its vocabulary, its calibration and its statistics."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.inference import MachineSpec, Weights
from app.inference.chains import SceneChains
from app.inference.objects import ObjectScorer
from app.inference.relation_units import RelationUnits, StandIns, relation_units
from app.model.calibration import Calibration, RelationSlopes
from app.model.possibility import CONTAINER, Possibility, UnitsWithPrior
from app.model.statistics import Counts, Offsets, Places
from app.model.word_weights import RowMap
from app.scene.roles import RoleCounts
from app.scene.spatial_relations import ON_TOP
from app.scene.stands import SUPPORTED, USUAL
from app.scene.vocabulary import Vocabulary, Word

_MOST_KEPT: Final = 4  # models with words that a model keeps, of about 20 MB each

_MOST_LISTED: Final = 256  # classes of a scene, and candidates of one computation

ROOM_SHARPNESS: Final = 1.5
"""Factor of the evidence of single classes for room types, which training keeps too small."""

_LEAST_SCENES: Final = 20  # minimum number of scenes of a pair that shows the height of a seat
_HIGHEST_SEAT: Final = 0.8  # maximum height of a seat, as a share of the height of the furniture
# Maximum median spread of the heights of things, as a share of the height of the furniture. Things
# in furniture with several shelves have a larger spread.
_SEAT_SPREAD: Final = 0.28


def derived_bytes(spec: MachineSpec) -> int:
    """Return a bound of the bytes in arrays whose size is a product of two sizes of a machine.

    Answers derive these arrays from the weights, which may be much smaller. The bound includes
    temporary arrays of one request.
    """
    V, H1, C, K, A, listed = spec.V, spec.H1, spec.C, spec.K, spec.A, _MOST_LISTED
    # The kernel of `RowMap`, `ObjectScorer.increases`, `Vocabulary.related`, and models with words.
    of_classes = (16 + 8 + 4 + 6 * _MOST_KEPT) * V * V + 32 * V * C
    of_samples = spec.N * (5 * V + 32 * H1 + 16 * listed)
    # The products of two directions of `SharedUnits`, and the factors of all pairs.
    of_pairs = A * (K + 1) ** 2 * (8 * H1 + 2 * listed)
    of_pairs += 4 * K * listed * (A * spec.units + 2 * listed)
    return of_classes + of_samples + of_pairs + 40 * H1 * H1 + 24 * listed * C * (1 + spec.profiles)


class RoomEvidence(NamedTuple):
    """The evidence of V classes for C room types; see `app.questions.several_rooms`."""

    log: Float[NDArray[np.float32], "V C"]
    odds: Float[NDArray[np.float32], "V C"]  # e^log
    top: Float[NDArray[np.float32], "V"]  # largest `log` of each class
    row: Int[NDArray[np.int64], "N"]  # of each class of the vocabulary; -1: structure


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A model, ready to answer questions."""

    weights: Weights
    vocabulary: Vocabulary
    calibration: Calibration
    offsets: Offsets | None = None  # None: no training scene has poses
    counts: Counts | None = None  # None: training has no numbers of instances
    places: Places | None = None  # None: no training scene has relations
    possibility: Possibility | None = None  # None: no class has a description

    @property
    def roles(self) -> RoleCounts | None:
        """Roles of boxes that reach into each other."""
        return None if self.places is None else self.places.roles

    @property
    def spread(self) -> Float[NDArray[np.float32], "V"] | None:
        """Standard deviations of the log of the sizes of the classes."""
        return None if self.possibility is None else self.possibility.spread

    @cached_property
    def containers(self) -> Float[NDArray[np.float64], "V"]:
        """Whether each class is a container: 1, sometimes (.5), or 0; 0 without a description."""
        if self.possibility is None:
            return np.zeros(self.spec.V)
        return np.maximum(self.possibility.traits[:, CONTAINER], 0.0).astype(np.float64)

    @cached_property
    def spec(self) -> MachineSpec:
        """Sizes and form of the machine."""
        return self.weights.spec

    @cached_property
    def objects(self) -> ObjectScorer:
        """Log-odds of classes and room types. The first access prepares the weights."""
        return ObjectScorer(self.weights)

    @cached_property
    def relation_units(self) -> RelationUnits:
        """Relation units of the machine, with the prior. The first access prepares the weights."""
        units = relation_units(self.weights)
        if self.possibility is None or self.places is None:
            return units
        return UnitsWithPrior(self.weights, units, self.descriptions, self.possibility, self.places)

    @cached_property
    def descriptions(self) -> Float[NDArray[np.float64], "V columns"]:
        """Rows of the prior of possibility for all trained classes, with their typical sizes."""
        if self.possibility is None:
            return np.zeros((self.spec.V, 0))
        V = len(self.possibility.spread)  # a model with words has further classes
        return self.possibility.rows(np.arange(V), self.vocabulary.sizes[:V])

    @cached_property
    def relation_slopes(self) -> RelationSlopes:
        """Calibration of the relations, as arrays."""
        return RelationSlopes.of(self.calibration)

    @cached_property
    def intruder_prior(self) -> Float[NDArray[np.float64], "V"]:
        """Log prior alpha · popularity of an intruder of each class; unseen ones as the rarest."""
        calibration, no_classes = self.calibration, np.zeros(0, np.int64)
        if not calibration.popularity:
            return np.zeros(self.spec.V)
        popularity = np.array(calibration.popularity, dtype=np.float64)
        empty_scene = self.weights["c1"], no_classes, no_classes.astype(np.float32)
        alone = self.objects.absent(*empty_scene, profile=None, coverage=1.0)
        rarest, alpha = np.nanmin(popularity), calibration.popularity_weight
        return np.where(np.isnan(popularity), alone - (1 - alpha) * rarest, alpha * popularity)

    @cached_property
    def room_prior(self) -> Float[NDArray[np.float64], "C"]:
        """log p(t) of each room type t in a scene without objects and without a profile."""
        return self.empty_room_log_p(None) if self.spec.C else np.zeros(0)

    def empty_room_log_p(self, profile: int | None) -> Float[NDArray[np.float64], "C"]:
        """Return log p(t) of each room type t in a scene without objects."""
        c1, nothing = self.weights["c1"], np.zeros(0, np.int64)
        return self.objects.room_log_p(c1[None], nothing, np.zeros((1, 0), np.float32), profile)[0]

    @cached_property
    def room_evidence(self) -> RoomEvidence:
        """The evidence of each class for each room type; see `app.questions.several_rooms`."""
        V, one = self.spec.V, np.ones((1, 1), np.float32)
        c1, W, objects = self.weights["c1"], self.weights["W"], self.objects
        alone = [
            objects.room_log_p((c1 + W[i])[None], np.array([i]), one, None)[0] for i in range(V)
        ]
        log = (ROOM_SHARPNESS * (np.stack(alone) - self.room_prior)).astype(np.float32)
        log[self.vocabulary.structure] = 0.0
        row = np.where(self.vocabulary.structure, -1, np.arange(V))
        return RoomEvidence(log, np.exp(log), log.max(1), row)

    @cached_property
    def rarely_shown(self) -> Bool[NDArray[np.bool_], "V"]:
        """True for classes that few of the training scenes show (`Calibration.rarely_shown`)."""
        return self.calibration.rarely_shown(self.spec.V)

    @cached_property
    def seats(self) -> Float[NDArray[np.float64], "V"]:
        """Height in metres of the seat of each class above its bottom, or infinity without a seat.

        The boxes of beds, sofas and chairs include a headboard or a back, so things lie below the
        top face. The seat is the lowest mean height of the bottoms of things of one class. A kind
        without statistics has the seat of its broader class.
        """
        sizes = self.vocabulary.sizes
        seats, is_known = np.full(len(sizes), math.inf), np.zeros(len(sizes), np.bool_)
        if self.offsets is None or self.places is None:
            return seats
        offsets, (_, V, _) = self.offsets, self.offsets.subject.shape
        relation, thing, other = offsets.pair // V // V, offsets.pair // V % V, offsets.pair % V
        height, typical = sizes[thing, 2], sizes[other, 2]
        bottoms = offsets.pair_offset[:, 2] - height / 2 + typical / 2
        is_shown = (relation == ON_TOP) & (offsets.pair_scenes >= _LEAST_SCENES)
        is_shown &= (height < typical) & (self.places.stands[thing, SUPPORTED] >= USUAL)
        for j in np.unique(other[is_shown]).tolist():
            rows, is_known[j] = is_shown & (other == j), True
            lowest, spread = bottoms[rows].min(), np.median(offsets.pair_offset[rows, 5])
            if lowest < _HIGHEST_SEAT * sizes[j, 2] and spread <= _SEAT_SPREAD * sizes[j, 2]:
                seats[j] = lowest
        ancestors = self.vocabulary.parents.copy()
        while (has_parent := ~is_known & (ancestors >= 0)).any():
            seats[has_parent] = seats[ancestors[has_parent]]
            is_known[has_parent] = is_known[ancestors[has_parent]]
            ancestors[has_parent] = self.vocabulary.parents[ancestors[has_parent]]
        return seats

    @cached_property
    def row_map(self) -> RowMap:
        """Regression from word vectors to weights. The first access takes about 0.5 s."""
        return RowMap.fit(self.weights, self.vocabulary)

    def with_words(self, words: Sequence[Word]) -> "SceneModel":
        """Return the model with a further class for each word, in the order of the words.

        The weights of such a class are predicted (`RowMap`). Its relations and its places are those
        of the nearest class. It never raises an alarm.
        """
        if not words:
            return self
        names = tuple(word.name for word in words)
        kept = self._with_words.get(names)
        if kept is None:
            popularity = self.calibration.popularity
            popularity = (*popularity, *(None for _ in words if popularity))
            kept = replace(
                self,
                weights=self.row_map.with_words(self.weights, words),
                vocabulary=self.vocabulary.with_words(words),
                calibration=self.calibration.model_copy(update={"popularity": popularity}),
            )
            # A reference to this model would close a cycle; see `app.serving.runtime`.
            stand_in = kept.vocabulary.stand_in
            if self.spec.C:
                row = self.room_evidence.row[stand_in]
                vars(kept)["room_evidence"] = self.room_evidence._replace(row=row)
            vars(kept)["relation_units"] = StandIns(kept.weights, self.relation_units, stand_in)
            if len(self._with_words) >= _MOST_KEPT:
                self._with_words.clear()  # in one step, because other threads read it
            self._with_words[names] = kept
        return kept

    @cached_property
    def _with_words(self) -> dict[tuple[str, ...], "SceneModel"]:
        return {}

    @cached_property
    def scene_chains(self) -> SceneChains:
        """Compiled Gibbs chains that sample scenes."""
        return SceneChains(self.weights, self.relation_units, self.calibration.rare_rooms)
