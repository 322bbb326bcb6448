"""Where missing things would stand, as places to draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from scene_reasoning.advisor import Advice

# Metres. What a spread is drawn as at least and at most.
_SMALLEST, _LARGEST = 0.05, 1.5


@dataclass(frozen=True)
class Ghost:
    """A missing thing.

    Attributes:
        text: what is missing, and where.
        position: x, y, z in metres in the frame of the detections: where it would stand, or the
            thing that it would stand by where no distance is known.
        extent: x, y, z in metres: two standard deviations of its place; None where unknown.
    """

    text: str
    position: tuple[float, float, float]
    extent: tuple[float, float, float] | None


def ghosts(advice: Advice, most: int) -> list[Ghost]:
    """The likeliest missing things that have a place, at most so many."""
    places = {
        thing["id"]: (thing["label"], thing["position"])
        for thing in advice.fields["objects"]
        if "position" in thing
    }
    found = []
    for missing in advice.answers.get("missing", {}).get("missing", ()):
        for placement in missing["placements"]:
            if len(found) < most and placement["object"] in places:
                found.append(_ghost(missing, placement, *places[placement["object"]]))
                break
    return found


def _ghost(missing: dict[str, Any], placement: dict[str, Any], label: str, anchor: Any) -> Ghost:
    text = f"{missing['label']}? {placement['relation']} {label}"
    offset = placement.get("offset")
    if offset is None:
        return Ghost(text, (anchor["x"], anchor["y"], anchor["z"]), None)
    x, y, z = (anchor[axis] + offset["mean"][axis] for axis in "xyz")
    across, along, up = (min(max(2 * offset["std"][axis], _SMALLEST), _LARGEST) for axis in "xyz")
    return Ghost(text, (x, y, z), (across, along, up))
