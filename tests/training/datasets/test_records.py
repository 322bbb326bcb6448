from __future__ import annotations

from typing import Any

import pytest

from training.datasets import AnnotatedObject, AnnotatedScene

BED, LAMP = AnnotatedObject("0", "bed"), AnnotatedObject("1", "lamp", supported_by="0")


def scene(**fields: Any) -> AnnotatedScene:
    return AnnotatedScene(
        **{"scene_id": "s", "source": "t", "group": "g", "room_type": None, "objects": (BED, LAMP)}
        | fields
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"objects": (BED, BED)}, "two objects with one id"),
        ({"objects": (LAMP,)}, "supported by '0': no such id"),
        ({"relations": ((0, "near", 1),)}, "unknown relation 'near'"),
        ({"relations": ((0, "left", 2),)}, "a relation names object 2 of 2"),
        ({"relations": ((-1, "left", 0),)}, "a relation names object -1 of 2"),
    ],
)
def test_scenes_that_cannot_be(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scene(**fields)
