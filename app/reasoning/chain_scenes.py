"""Scenes drawn by compiled chains, one by one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from app.inference import MachineSpec, philox
from app.inference.scene_chains import ConditionedChains, Conditions, Drawn
from app.reasoning.answers import GeneratedScene
from app.reasoning.exclusion import Triple, staying
from app.reasoning.given import given_relations
from app.reasoning.plausible import ATTEMPTS, Plausible
from app.reasoning.present import Present, present
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL
from app.scene.scene import Scene


def chain_scenes(
    artifact: Artifact,
    scene: Scene,
    count: int,
    seed: int,
    steps: int,
    temperature: float,
    context: Mapping[str, Sequence[int]],
    stop: Callable[[], bool],
) -> tuple[GeneratedScene, ...]:
    """See `generate`."""
    spec = artifact.spec
    classes = present(scene, spec)
    conditions = _conditions(scene, classes, spec.A, _held_units(spec, context))
    conditioned = artifact.scene_chains.given(conditions, temperature)
    shown = ~artifact.vocabulary.structure
    shown[classes.classes] = True
    of = classes.classes[classes.row].tolist()
    given = {(a, of[i], of[j]) for a, i, j in scene.relations or ()}
    scenes: list[GeneratedScene] = []
    plausible = Plausible(artifact, scene)
    while len(scenes) < count and not stop():
        stream = philox.stream(seed, len(scenes))
        for attempt in range(ATTEMPTS):
            drawn = conditioned.draw(steps, stream)
            found = _scene(artifact, conditioned, drawn, shown[drawn.classes], given)
            if plausible(found.objects) or stop() or attempt == ATTEMPTS - 1:
                scenes.append(found)
                break
    return tuple(scenes)


def _conditions(
    scene: Scene, classes: Present, relations: int, held: Mapping[str, NDArray[np.int64]]
) -> Conditions:
    given = given_relations(scene, classes, relations)
    a = i = j = np.zeros(0, dtype=np.int64)
    r = np.zeros(0, dtype=np.bool_)
    if given is not None:
        a, i, j, r = given.a, given.i, given.j, given.r > 0
    return Conditions(
        classes=classes.classes,
        log_counts=classes.log_counts,
        a=a,
        i=i,
        j=j,
        r=r,
        held=held["h1"],
        held2=held["h2"],
        room=scene.room_type,
    )


def _held_units(
    spec: MachineSpec, context: Mapping[str, Sequence[int]]
) -> dict[str, NDArray[np.int64]]:
    """The hidden units of each layer that are held on.

    Raises:
        ValueError: a layer or a unit that the machine does not have.
    """
    sizes = {"h1": spec.H1, "h2": spec.H2}
    for layer, units in context.items():
        if not sizes.get(layer):
            raise ValueError(f"the model has no layer {layer!r}")
        for unit in units:
            if not 0 <= unit < sizes[layer]:
                raise ValueError(f"unit {unit} of {layer} must be below {sizes[layer]}")
    return {layer: np.unique(np.array(context.get(layer, ()), dtype=np.int64)) for layer in sizes}


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
