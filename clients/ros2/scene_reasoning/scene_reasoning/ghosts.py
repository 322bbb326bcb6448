"""Ghosts: markers for missing objects, at their likely positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from scene_reasoning.advisor import Advice

# Smallest and largest extent of a marker, in metres.
_SMALLEST, _LARGEST = 0.05, 1.5


@dataclass(frozen=True)
class Ghost:
    """A marker for a missing object.

    Attributes:
        text: word of the request for the missing object, or else its class; and its relation to
            the anchor.
        position: x, y, z in metres in the frame of the detections. If the offset from the anchor is
            unknown, this is the position of the anchor.
        extent: x, y, z in metres: two standard deviations of the position; None if unknown.
    """

    text: str
    position: tuple[float, float, float]
    extent: tuple[float, float, float] | None


def ghosts(advice: Advice, most: int) -> list[Ghost]:
    """Markers for the likeliest missing objects whose anchor has a position, at most `most`."""
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
    name = missing.get("listed_as") or missing["label"]
    text = f"{name}? {placement['relation']} {label}"
    offset = placement.get("offset")
    if offset is None:
        return Ghost(text, (anchor["x"], anchor["y"], anchor["z"]), None)
    x, y, z = (anchor[axis] + offset["mean"][axis] for axis in "xyz")
    across, along, up = (min(max(2 * offset["std"][axis], _SMALLEST), _LARGEST) for axis in "xyz")
    return Ghost(text, (x, y, z), (across, along, up))
