"""Pictures of scenes: boxes are separate or nested, and what can be drawn as stated is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scene_client.schemas import (
    GenerateAnswer,
    GeneratedRelation,
    GeneratedScene,
    ModelReference,
    RelationName,
)

plot = pytest.importorskip("scene_client.plot", exc_type=ImportError)

if TYPE_CHECKING:
    from scene_client.plot import Box

NAMES = ["bed", "desk", "lamp", "book", "a rather long name", "x", "chair", "mug"]
RELATIONS = get_args(RelationName)


def stated(*relations: tuple[str, str, str]) -> list[GeneratedRelation]:
    names = ("subject", "relation", "object")
    return [GeneratedRelation(**dict(zip(names, each, strict=True))) for each in relations]


def boxes(objects: list[str], *relations: tuple[str, str, str]) -> dict[str, Box]:
    return {box.label: box for box in plot.arrange(objects, stated(*relations))}


def is_inside(inner: Box, outer: Box) -> bool:
    return (
        outer.x < inner.x
        and outer.y < inner.y
        and inner.x + inner.width < outer.x + outer.width
        and inner.y + inner.height <= outer.y + outer.height - plot.HEIGHT + 1e-9
    )


objects = st.lists(st.sampled_from(NAMES), unique=True, max_size=8)
triples = st.tuples(st.sampled_from(NAMES), st.sampled_from(RELATIONS), st.sampled_from(NAMES))


@given(objects=objects, relations=st.lists(triples, max_size=30))
def test_every_object_is_drawn_once_and_only_contents_overlap_their_container(
    objects: list[str], relations: list[tuple[str, str, str]]
) -> None:
    found = plot.arrange(objects, stated(*relations))
    holders = {a for a, relation, _ in relations if relation == "contains"}
    holders |= {b for _, relation, b in relations if relation == "inside"}
    assert sorted(box.label for box in found) == sorted(objects)
    for place, one in enumerate(found):
        assert one.x >= 0
        assert one.y >= 0
        for other in found[:place]:
            apart = (
                one.x >= other.x + other.width - 1e-9
                or other.x >= one.x + one.width - 1e-9
                or one.y >= other.y + other.height - 1e-9
                or other.y >= one.y + one.height - 1e-9
            )
            outer, inner = sorted((one, other), key=lambda box: -box.height)
            nested = outer.label in holders and is_inside(inner, outer)
            assert apart or nested, (one, other)


def answer(*scenes: GeneratedScene) -> GenerateAnswer:
    model = ModelReference(name="home", version="1.0.0", variant="rbm", digest="0")
    return GenerateAnswer(model=model, request_id="r", seed=7, scenes=list(scenes))


def scene(objects: list[str], *relations: tuple[str, str, str]) -> GeneratedScene:
    return GeneratedScene(objects=objects, relations=stated(*relations), log_score=-1.0, context={})


@pytest.mark.parametrize("count", [1, 3, 16])
def test_every_scene_is_in_the_picture(tmp_path: Path, count: int) -> None:
    relations = [("lamp", "on-top", "desk"), ("lamp", "left", "$chair$"), ("lamp", "left", "bed")]
    room = scene(["desk", "lamp", "$chair$"], *relations)  # without a bed
    path = tmp_path / "scenes.svg"
    plot.draw(answer(*[room] * count), path)
    text = path.read_text()
    assert text.count("<!-- desk -->") == count
    assert f"scene {count} of seed 7" in text
