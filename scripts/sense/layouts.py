"""``python -m scripts.sense.layouts URL``: judge how the web page draws generated scenes.

The script asks a running service for 100 scenes: 10 of each room type in `ROOMS`. A browser runs
the page's own `layout.js` on each scene. The script counts:

- layouts with overlapping boxes, and overlapping pairs. Two boxes overlap if they reach more than
  `TOUCH` into each other in all three directions, and neither is in the other. A thing is in its
  container, and in the container of the thing that it is on or in.
- hanging things that stand: things that hang on a wall or from the ceiling by the table of things,
  and whose box stands on the floor or on another box, although no relation says so.
- broken relations: relations of the scene that the service does not observe in the boxes.
- impossible pairs: relations *on-top* and *inside* of the scene, whatever its boxes. The footprint
  of the subject is more than `LARGER` times that of the object, or the table of things says that
  nothing is put on or into the object.

The script needs Debian's chromium and the development dependencies.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import httpx
from playwright.sync_api import sync_playwright

from training.datasets.inventories import Thing, shipped_things

ROOMS: Final = (
    "bathroom", "bedroom", "classroom", "dining room", "garage", "hospital room", "kitchen",
    "living room", "office", "workshop",
)  # fmt: skip
SCENES: Final = 10  # of each room type
SEED: Final = 55
TOUCH: Final = 0.01  # depth in metres of boxes that only touch
CONTACT: Final = 0.05  # maximum distance in metres between a box and its support
LARGER: Final = 1.5  # minimum ratio of footprints of an impossible pair
SHOWN: Final = 12  # examples in a list
HOLDS: Final = {"on-top": "surface", "inside": "container"}
"""The relations that hold a thing, and the property that their object needs."""

Box = dict[str, Any]
Triple = tuple[str, str, str]

LAY_OUT: Final = """async ([scenes, classes]) => {
  const { layOut } = await import('/static/board/layout.js');
  const sizes = new Map(classes.map(({ label, size }) => [label, size]));
  const hanging = new Set(classes.filter(({ hangs }) => hangs).map(({ label }) => label));
  const began = performance.now();
  const layouts = scenes.map(({ objects, relations }) => layOut([], objects.map((label) => ({
    id: label, label, yaw: 0, z: 0, size: sizes.get(label) ?? { x: 0.4, y: 0.4, z: 0.4 },
  })), relations, { x: 0, y: 0, yaw: 0 }, hanging));
  return [layouts, (performance.now() - began) / scenes.length];
}"""
"""Lays out scenes as `generation.js` does. Returns the boxes, and milliseconds for each scene."""


class Things:
    """The table of things, by class. A class without a row has the row of its parent."""

    def __init__(self, classes: list[dict[str, Any]]) -> None:
        self.rows = shipped_things()
        self.parents = {entry["label"]: entry.get("parent") for entry in classes}

    def row(self, label: str) -> Thing | None:
        """Return the row of a class or of its nearest ancestor with a row."""
        name: str | None = label
        while name is not None and name not in self.rows:
            name = self.parents.get(name)
        return None if name is None else self.rows[name]

    def hangs(self, label: str) -> bool:
        """Return whether most things of a class hang on a wall or from the ceiling."""
        row = self.row(label)
        return row is not None and row.stands.get("wall", 0) + row.stands.get("ceiling", 0) > 0.5

    def faults(self, triple: Triple) -> Iterator[str]:
        """Yield the reasons why a relation *on-top* or *inside* is impossible."""
        subject, relation, anchor = triple
        own, other = self.row(subject), self.row(anchor)
        if other is None or relation not in HOLDS:
            return
        if own is not None and footprint(own) > LARGER * footprint(other):
            yield f"larger than its {HOLDS[relation]}"
        if getattr(other, HOLDS[relation]) == "no":
            yield f"no {HOLDS[relation]}"


def footprint(thing: Thing) -> float:
    return thing.size[0] * thing.size[1]


def main() -> None:
    """Print the counts for the service at a URL."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("url", help="URL of a running service")
    parser.add_argument("--json", type=Path, help="file for the scenes and their boxes")
    options = parser.parse_args()
    with httpx.Client(base_url=options.url, timeout=120) as client:
        classes = client.get("/models/default/vocabulary").raise_for_status().json()["objects"]
        scenes = [scene for room in ROOMS for scene in generated(client, room)]
        layouts, milliseconds = laid_out(options.url, scenes, classes)
        print_layouts(client, scenes, layouts, Things(classes))
        print(f"time of the layout: {milliseconds:.1f} ms a scene")
        print_impossible(scenes, Things(classes))
    if options.json:
        options.json.write_text(json.dumps({"scenes": scenes, "layouts": layouts}), "utf-8")


def generated(client: httpx.Client, room: str) -> list[dict[str, Any]]:
    body = {"room_type": room, "count": SCENES, "seed": SEED}
    scenes: list[dict[str, Any]] = (
        client.post("/generate", json=body).raise_for_status().json()["scenes"]
    )
    return scenes


def laid_out(
    url: str, scenes: list[dict[str, Any]], classes: list[dict[str, Any]]
) -> tuple[list[list[Box]], float]:
    """Run the page's layout on scenes. Return their boxes, and the time in ms of a layout."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--headless", "--no-sandbox"]
        )
        page = browser.new_page()
        page.goto(url, wait_until="load")
        layouts, milliseconds = page.evaluate(LAY_OUT, [scenes, classes])
        browser.close()
    return layouts, milliseconds


def print_layouts(
    client: httpx.Client, scenes: list[dict[str, Any]], layouts: list[list[Box]], things: Things
) -> None:
    """Print how many boxes overlap, how many hanging things stand, and the broken relations."""
    pairs, standing = Counter[tuple[str, str]](), Counter[str]()
    overlapping, objects, hanging = 0, 0, 0
    stated, broken = Counter[str](), Counter[str]()
    for scene, boxes in zip(scenes, layouts, strict=True):
        triples = triples_of(scene["relations"])
        found = list(overlaps(boxes, triples))
        pairs.update(found)
        overlapping += bool(found)
        objects += len(boxes)
        alone = hanging_alone(boxes, triples, things)
        hanging += len(alone)
        standing.update(box["id"] for box in alone if is_supported(box, boxes))
        stated.update(relation for _, relation, _ in triples)
        broken.update(relation for _, relation, _ in triples - observed(client, boxes))
    print(f"{len(scenes)} layouts of {objects} objects")
    print(f"layouts with overlapping boxes: {overlapping}")
    print(f"overlapping pairs: {pairs.total() / len(scenes):.2f} a layout; {listed(pairs)}")
    print(f"hanging things that stand: {standing.total()} of {hanging}; {listed(standing)}")
    print(f"broken relations: {broken.total()} of {stated.total()}, {share(broken, stated)}")


def share(part: Counter[str], whole: Counter[str]) -> str:
    return ", ".join(f"{name} {part[name]}/{whole[name]}" for name in sorted(whole))


def listed(found: Counter[Any]) -> str:
    words = (" and ".join(key) if isinstance(key, tuple) else key for key, _ in found.most_common())
    return ", ".join(list(words)[:SHOWN])


def triples_of(relations: list[dict[str, str]]) -> set[Triple]:
    return {(one["subject"], one["relation"], one["object"]) for one in relations}


def contents(triples: set[Triple]) -> set[tuple[str, str]]:
    """Return the pairs (thing, container), also of things on or in a thing in the container."""
    holders: dict[str, set[str]] = {}
    for subject, relation, anchor in triples:
        if relation in HOLDS:
            holders.setdefault(subject, set()).add(anchor)
    found = {(subject, anchor) for subject, relation, anchor in triples if relation == "inside"}
    while True:
        more = {
            (subject, container)
            for subject, anchors in holders.items()
            for thing, container in found
            if thing in anchors
        }
        if more <= found:
            return found
        found |= more


def depth(a: Box, b: Box, axis: str) -> float:
    """Return how far two boxes reach into each other along an axis, in metres."""
    (low, high), (start, end) = extent(a, axis), extent(b, axis)
    return min(high, end) - max(low, start)


def extent(box: Box, axis: str) -> tuple[float, float]:
    """Return the lower and the upper end of a box that is not rotated; z is that of its bottom."""
    size: float = box["size"][axis]
    low: float = box[axis] - (0 if axis == "z" else size / 2)
    return low, low + size


def overlaps(boxes: list[Box], triples: set[Triple]) -> Iterator[tuple[str, str]]:
    within = contents(triples)
    for a, b in combinations(boxes, 2):
        names = a["id"], b["id"]
        is_deep = all(depth(a, b, axis) > TOUCH for axis in "xyz")
        if is_deep and names not in within and names[::-1] not in within:
            yield names


def hanging_alone(boxes: list[Box], triples: set[Triple], things: Things) -> list[Box]:
    """Return the boxes of hanging things that are on or in no other thing."""
    held = {subject for subject, relation, _ in triples if relation in HOLDS}
    return [box for box in boxes if things.hangs(box["id"]) and box["id"] not in held]


def is_supported(box: Box, boxes: list[Box]) -> bool:
    """Return whether a box stands on the floor or on another box."""
    under = (b for b in boxes if b is not box and min(depth(b, box, axis) for axis in "xy") > TOUCH)
    tops = [0.0, *(extent(b, "z")[1] for b in under)]
    return any(abs(box["z"] - top) <= CONTACT for top in tops)


def observed(client: httpx.Client, boxes: list[Box]) -> set[Triple]:
    """Return the relations that the service observes in boxes."""
    objects = [
        {
            "id": box["id"],
            "label": box["label"],
            "position": {**{k: box[k] for k in "xy"}, "z": box["z"] + box["size"]["z"] / 2},
            "size": box["size"],
        }
        for box in boxes
    ]
    body = {"objects": objects, "frame_id": "map", "viewpoint": {"x": 0, "y": 0, "yaw": 0}}
    answer = client.post("/relations", json=body | {"top_k": 1}).raise_for_status().json()
    return triples_of(answer.get("observed_relations", []))


def print_impossible(scenes: list[dict[str, Any]], things: Things) -> None:
    """Print the impossible pairs of scenes, by reason."""
    reasons: dict[str, Counter[str]] = defaultdict(Counter)
    relations, impossible, affected = 0, 0, 0
    for scene in scenes:
        held = [triple for triple in triples_of(scene["relations"]) if triple[1] in HOLDS]
        faults = {triple: found for triple in held if (found := list(things.faults(triple)))}
        relations, impossible, affected = (
            relations + len(held), impossible + len(faults), affected + bool(faults)
        )  # fmt: skip
        for triple, found in faults.items():
            for reason in found:
                reasons[reason][" ".join(triple)] += 1
    print(f"impossible pairs: {impossible} of {relations} relations, in {affected} scenes")
    for reason, examples in sorted(reasons.items()):
        print(f"  {reason}: {examples.total()}; {listed(examples)}")


if __name__ == "__main__":
    main()
