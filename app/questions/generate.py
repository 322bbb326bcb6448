"""What would a scene like this look like?

A chain now and then ends between two kinds of rooms: almost empty, or with a thing that belongs to
neither. A drawn scene is drawn again where

- it has fewer classes than nine in ten real rooms of its type (`Calibration.smallest`),
- it suits its room type less than 85 % of the real rooms of that type (`Calibration.room_fit`), or
- one of its classes raises an alarm of `/outliers` at the default sensitivity.

What a request gives is never a reason. The last of `ATTEMPTS` draws is always taken.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference import MachineSpec, Weights
from app.inference.chains import ConditionedChains, Conditions, Drawn, random_stream
from app.inference.elementary import softplus
from app.questions.outliers import intruder_probability
from app.questions.posterior import given_relations, posterior, present
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, FRONT, LEFT, ON_TOP
from app.scene.scene import Scene, SceneObject

Triple = tuple[int, int, int]

STEPS: Final = 50
"""Gibbs sweeps of a chain unless a request says otherwise."""

ATTEMPTS: Final = 8
"""Draws of a scene at most."""

# The direction of each relation: left, front or, for all others, up. A thing on another is higher,
# as one above it.
_DIRECTION: Final = np.array([{LEFT: 1, FRONT: 2}.get(a, 0) for a in range(len(CANONICAL))])


@dataclass(frozen=True, slots=True)
class GeneratedScene:
    """A drawn scene.

    Attributes:
        objects: canonical labels of its classes, in the order of the vocabulary.
        relations: canonical (subject, relation, object) over labels.
        log_score: see `ConditionedChains.log_score`; comparable between scenes of one model.
        context: layer name to its active units.
    """

    objects: tuple[str, ...]
    relations: tuple[tuple[str, str, str], ...]
    log_score: float
    context: dict[str, tuple[int, ...]]


def generate(
    artifact: Artifact,
    scene: Scene,
    *,
    count: int = 1,
    seed: int,
    steps: int | None = None,
    temperature: float = 1.0,
    context: Mapping[str, Sequence[int]] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[GeneratedScene, ...]:
    """Draw scenes that contain the evidence, by Gibbs chains that start at fantasies.

    Objects of the scene are in every drawn one, whatever their confidence, and so are its
    relations; what it shows not to hold stays off; all else is drawn. Structure that is no
    evidence is drawn with the rest and left out of the answer.

    Every chain has a random stream of its own. So scene k depends on the seed and on k, not on how
    many others a request asked for.

    Structure stands in no relation but those of the evidence.

    The drawn relations can hold all at once (`staying`): two classes have one at most, a class is
    on top of one other at most, and no circle of left, front or above closes. Evidence stays in any
    case. A class stands in a relation to itself only where the evidence says so, since a drawn
    scene holds every class once.

    Args:
        count: how many scenes.
        seed: of the random numbers; the same seed draws the same scenes.
        steps: Gibbs sweeps of a chain, `STEPS` by default.
        temperature: of the chains; above 1 for more varied scenes.
        context: layer name ("h1", "h2") to the units that are held on.
        stop: asked between scenes; once it says so, those drawn so far are all.

    Raises:
        ValueError: a number out of range, or a layer or unit that the machine does not have.
    """
    steps = STEPS if steps is None else steps
    if count < 1:
        raise ValueError(f"count must be at least 1, not {count}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, not {seed}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, not {temperature}")
    conditions = _conditions(artifact, scene, context or {})
    conditioned = artifact.scene_chains.given(conditions, temperature)
    shown = ~artifact.vocabulary.structure
    shown[conditions.classes] = True
    of = [thing.class_index or 0 for thing in scene.objects]
    given = {(a, of[i], of[j]) for a, i, j in scene.relations or ()}
    scenes: list[GeneratedScene] = []
    plausible = Plausible(artifact, scene)
    while len(scenes) < count and not stop():
        stream = random_stream(seed, len(scenes))
        for attempt in range(ATTEMPTS):
            drawn = conditioned.draw(steps, stream)
            seen = shown[drawn.classes]
            if plausible(drawn.classes[seen].tolist()) or stop() or attempt == ATTEMPTS - 1:
                scenes.append(_scene(artifact, conditioned, drawn, seen, given))
                break
    return tuple(scenes)


def _conditions(
    artifact: Artifact, scene: Scene, context: Mapping[str, Sequence[int]]
) -> Conditions:
    """What stays as it is, with the hidden units of each layer that are held on.

    Raises:
        ValueError: a layer or a unit that the machine does not have.
    """
    spec, classes = artifact.spec, present(scene, artifact.spec)
    sizes = {"h1": spec.H1, "h2": spec.H2}
    for layer, units in context.items():
        if not sizes.get(layer):
            raise ValueError(f"the model has no layer {layer!r}")
        for unit in units:
            if not 0 <= unit < sizes[layer]:
                raise ValueError(f"unit {unit} of {layer} must be below {sizes[layer]}")
    held = [np.unique(np.array(context.get(layer, ()), dtype=np.int64)) for layer in sizes]
    return Conditions(
        classes.classes,
        classes.log_counts,
        given_relations(scene, classes, spec.A),
        held[0],
        held[1],
        scene.room_type,
    )


def _scene(
    artifact: Artifact,
    chains: ConditionedChains,
    drawn: Drawn,
    shown: NDArray[np.bool_],
    given: set[Triple],
) -> GeneratedScene:
    labels = artifact.vocabulary.labels
    units = np.nonzero(drawn.r & shown[:, None] & shown)
    a, i, j = units
    named = np.stack([a, drawn.classes[i], drawn.classes[j]], axis=1)
    stay = staying(named, drawn.logits[units], given, artifact.vocabulary.structure)
    kept = np.zeros_like(drawn.r)
    kept[units] = stay
    triples = sorted({*map(tuple, named[stay].tolist()), *given})
    return GeneratedScene(
        objects=tuple(labels[index] for index in drawn.classes[shown].tolist()),
        relations=tuple((labels[i], CANONICAL[a], labels[j]) for a, i, j in triples),
        log_score=chains.log_score(drawn, shown, kept),
        context=_layers(artifact.spec, drawn),
    )


def _layers(spec: MachineSpec, drawn: Drawn) -> dict[str, tuple[int, ...]]:
    layers = {"h1": tuple(drawn.h1.tolist())}
    if spec.H2:
        layers["h2"] = tuple(drawn.h2.tolist())
    return layers


def staying(
    units: NDArray[np.int64],
    logits: NDArray[np.floating[Any]],
    given: Collection[Triple],
    structure: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Which of the drawn relations stay, (m,).

    Those that are given do. The others are taken from the likeliest on. One stays if

    - its two classes have no relation yet (`app.scene.geometry` finds at most one),
    - it closes no circle, such as A left of B, B left of C, C left of A,
    - its first class has no other support yet, where it is *on-top*.

    A class stands in no relation to itself. Structure stands in none: training drops its relations,
    so those that are drawn have no meaning.

    Args:
        units: (m, 3) distinct (a, i, j) over classes.
        logits: (m,) of each; where two are equal, the smaller (a, i, j) comes first.
        given: (a, i, j) over classes.
        structure: (V,) which classes are.
    """
    fixed = np.array(sorted(given), dtype=np.int64).reshape(-1, 3)
    order = np.lexsort((*units.T[::-1], -logits))
    possible = (units[:, 1] != units[:, 2]) & ~structure[units[:, 1:]].any(axis=1)
    every = np.concatenate([fixed, units])
    classes, places = np.unique(every[:, 1:], return_inverse=True)
    stay: NDArray[np.bool_] = _holding(
        np.ascontiguousarray(every[:, 0]),
        *(places.reshape(-1, 2), order[possible[order]], len(fixed), len(classes)),
    )
    if given:
        shape = len(CANONICAL), len(structure), len(structure)
        stay |= np.isin(np.ravel_multi_index(units.T, shape), np.ravel_multi_index(fixed.T, shape))
    return stay


@compiled
def _holding(
    relation: NDArray[np.int64],
    places: NDArray[np.int64],
    order: NDArray[np.int64],
    given: int,
    count: int,
) -> NDArray[np.bool_]:
    """Which of m relations hold beside those that are given, (m,).

    Args:
        relation: (given + m,), those that are given first.
        places: (given + m, 2) of the two classes.
        order: of those to try, 0 to m - 1, likeliest first.
        given: how many are given.
        count: n, how many classes there are.
    """
    # beyond[d, x, y]: y lies beyond x in direction d.
    beyond = np.zeros((3, count, count), np.bool_)
    related, supported = np.zeros((count, count), np.bool_), np.zeros(count, np.bool_)
    stay = np.zeros(len(relation) - given, np.bool_)
    for turn in range(given + len(order)):
        e = turn if turn < given else given + order[turn - given]
        x, y, far = places[e, 0], places[e, 1], beyond[_DIRECTION[relation[e]]]
        on_top = relation[e] == ON_TOP
        if turn >= given:
            if far[y, x] or related[x, y] or (on_top and supported[x]):
                continue
            stay[e - given] = True
        related[x, y] = related[y, x] = True
        supported[x] |= on_top
        for k in range(count):
            if k == x or far[k, x]:
                far[k] |= far[y]
                far[k, y] = True
    return stay


class Plausible:
    """The test of drawn scenes for one request.

    Args:
        artifact: the model that draws.
        scene: the evidence.
    """

    def __init__(self, artifact: Artifact, scene: Scene) -> None:
        self._artifact, self._room = artifact, scene.room_type
        self._given = {thing.class_index for thing in scene.objects}
        smallest = artifact.calibration.smallest
        # The last entry is for any room.
        self._least = 0
        if smallest:
            self._least = smallest[-1 if scene.room_type is None else scene.room_type]

    def __call__(self, classes: list[int]) -> bool:
        """Whether a drawn scene of these classes is one."""
        if len(classes) < self._least or not self._suits_room(classes):
            return False
        if not classes:
            return True
        labels = self._artifact.vocabulary.labels
        objects = [SceneObject(labels[index], labels[index], index) for index in classes]
        judged = Scene(tuple(objects), room_type=self._room)
        # A drawn scene is whole, however few its classes are.
        whole = self._artifact.calibration.outlier_thresholds.medium
        given = posterior(self._artifact, judged)
        is_intruder = intruder_probability(self._artifact, given) >= whole
        return self._given.issuperset(given.present.classes[is_intruder].tolist())

    def _suits_room(self, classes: list[int]) -> bool:
        limits = self._artifact.calibration.room_fit
        if self._room is None or not limits:
            return True
        v = np.zeros((1, self._artifact.spec.V), dtype=np.float32)
        v[0, classes] = 1.0
        return bool(room_fit(self._artifact.weights, v, self._room)[0] >= limits[self._room])


def room_fit(weights: Weights, v: NDArray[np.float32], room: int) -> NDArray[np.float64]:
    """log p(v | room type) / p(v), up to a constant of the room type, (B,), for presence (B, V).

    sum_k [softplus(x_k + Q_tk) - softplus(x_k)],   x = c1 + v'W

    A second layer is left out.
    """
    x = weights["c1"] + v @ weights["W"]
    change = softplus(x + weights["Q"][room]) - softplus(x)
    found: NDArray[np.float64] = np.sum(change, axis=1, dtype=np.float64)
    return found
