"""What would a scene like this look like?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from app.reasoning.answers import GeneratedScene
from app.reasoning.chain_scenes import chain_scenes
from app.registry.artifact import Artifact
from app.scene.scene import Scene

STEPS = 50
"""Gibbs sweeps of a chain unless a request says otherwise."""


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
    return chain_scenes(artifact, scene, count, seed, steps, temperature, context or {}, stop)
