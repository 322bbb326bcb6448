"""Pictures of generated scenes. A picture shows objects as boxes.

A picture shows the scene from the view of the robot. Objects on the left of the scene are on the
left, near objects are at the bottom, and a supported object is above its support. The box of an
object inside another object is inside its box. All other boxes are separate. If relations
contradict each other, the earlier relation of the answer decides. The module needs matplotlib,
which is in the dependency group `training`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import ceil, sqrt
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from scene_client.schemas import GenerateAnswer, GeneratedScene, Relation

HEIGHT: Final = 1.0
GAP: Final = 0.6
"""Gap between neighbouring boxes, in the unit of `HEIGHT`, the height of a box."""
_WALL: Final = 0.2  # gap between a container and its contents

# Colour and line style of each relation. The relations on-top and inside have no lines, because
# their boxes touch.
_STYLES: Final = {"above": ("#2d7a2d", ":"), "front": ("#b34700", "--"), "left": ("#1f5fa8", "-")}
_BOX: Final[dict[str, Any]] = {
    "boxstyle": "round,pad=0,rounding_size=0.15",
    "facecolor": "#f2f2f2",
    "edgecolor": "#333333",
    "linewidth": 0.8,
    "zorder": 2,
}
# Inches per unit of length (the height of a box). With this scale, a label fits into its box.
_UNIT: Final = 0.32
_POINTS: Final = 7
# Space for the title and the legend of each scene, in units of length.
_MARGIN: Final = 4.0
_MAX_PIXELS: Final = 6000


def draw(answer: GenerateAnswer, path: Path) -> None:
    """Write a picture of all scenes to a file. The suffix of ``path`` selects the file format.

    Raises:
        ValueError: matplotlib does not support the file format.
        OSError: the file cannot be written.
    """
    layouts = [arrange(scene.objects, scene.relations) for scene in answer.scenes]
    columns = ceil(sqrt(len(layouts)))
    extents = [extent(layout) for layout in layouts]
    # The scenes fill a grid row by row. Each column is as wide as its widest scene.
    widths = [max(width for width, _ in extents[n::columns]) + _MARGIN for n in range(columns)]
    heights = [
        max(height for _, height in extents[start : start + columns]) + _MARGIN
        for start in range(0, len(layouts), columns)
    ]
    size = (sum(widths) * _UNIT, sum(heights) * _UNIT)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(len(heights), columns, width_ratios=widths, height_ratios=heights)
    for index, (scene, layout) in enumerate(zip(answer.scenes, layouts, strict=True)):
        axes = figure.add_subplot(grid[index // columns, index % columns])
        axes.set_title(f"scene {index + 1} of seed {answer.seed}", fontsize=_POINTS + 2)
        _draw(axes, scene, layout)
    figure.savefig(path, dpi=min(150.0, _MAX_PIXELS / max(size)))


def _draw(axes: Axes, scene: GeneratedScene, boxes: list[Box]) -> None:
    axes.set_axis_off()
    axes.set_aspect("equal")
    for box in boxes:
        axes.add_patch(FancyBboxPatch((box.x, box.y), box.width, box.height, **_BOX))
        # The label of a container is above its contents.
        middle = (box.x + box.width / 2, box.y + box.height - HEIGHT / 2)
        # In matplotlib, an unescaped dollar sign starts a formula.
        text = box.label.replace("$", r"\$")
        axes.text(*middle, text, ha="center", va="center", fontsize=_POINTS, zorder=3)
    centres = {box.label: (box.x + box.width / 2, box.y + box.height / 2) for box in boxes}
    for name, (color, dashes) in _STYLES.items():
        lines = [
            zip(centres[one.subject], centres[one.object], strict=True)
            for one in scene.relations
            if one.relation == name and {one.subject, one.object} <= centres.keys()
        ]
        for ends in lines:
            axes.plot(*ends, color=color, linestyle=dashes, linewidth=0.7, alpha=0.5, zorder=1)
        if lines:
            axes.plot([], [], color=color, linestyle=dashes, label=name)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, fontsize=_POINTS, frameon=False
        )
    width, height = extent(boxes)
    axes.set_xlim(-GAP, width + GAP)
    axes.set_ylim(-GAP, height + GAP)


# ------------------------------------------------------------------------------------ layout

# Maps a relation to its opposite. The picture shows only the opposite, with subject and object
# exchanged.
_OPPOSITES: Final = {
    "right": "left",
    "behind": "front",
    "under": "on-top",
    "below": "above",
    "contains": "inside",
}


@dataclass(frozen=True, slots=True)
class Box:
    """The box of one object in the picture: label, lower left corner, width and height."""

    label: str
    x: float
    y: float
    width: float
    height: float


def extent(boxes: Sequence[Box]) -> tuple[float, float]:
    """Return the largest x and the largest y of all boxes."""
    right = max((box.x + box.width for box in boxes), default=0.0)
    return right, max((box.y + box.height for box in boxes), default=0.0)


class _Order:
    """Order of the objects along one axis of the picture, as a graph without cycles."""

    def __init__(self, names: Iterable[str]) -> None:
        self._before: dict[str, set[str]] = {name: set() for name in names}

    def add(self, first: str, second: str) -> None:
        """Put the object ``first`` before ``second``, unless this would close a cycle."""
        if second == first or second in self._before[first]:
            return
        earlier = {first} | self._before[first]
        for name, before in self._before.items():
            if name == second or second in before:
                before |= earlier

    def ranks(self) -> dict[str, int]:
        """Return the length of the longest chain of predecessors of each object."""
        ranks: dict[str, int] = {}
        for name in sorted(self._before, key=lambda name: len(self._before[name])):
            ranks[name] = max((ranks[other] + 1 for other in self._before[name]), default=0)
        return ranks


def arrange(objects: Sequence[str], relations: Iterable[Relation]) -> list[Box]:
    """Return the boxes of all objects, in no particular order. The smallest x and y are 0.

    Args:
        objects: names of the objects, without duplicates.
        relations: relations between the objects.
    """
    triples = [_canonical(relation) for relation in relations]
    triples = [(a, name, b) for a, name, b in triples if a != b and a in objects and b in objects]
    below = _supporters(triples)
    roots = [name for name in objects if name not in below]
    root = {name: _root(name, below) for name in objects}
    piles = {name: _pile(name, below) for name in roots}

    columns, rows = _Order(roots), _Order(roots)
    for subject, relation, object in triples:
        order = {"left": columns, "front": rows}.get(relation)
        if order is not None and root[subject] != root[object]:
            order.add(root[subject], root[object])
    column, row = columns.ranks(), rows.ranks()

    cells: dict[tuple[int, int], list[list[Box]]] = {}
    for name in roots:
        cells.setdefault((column[name], row[name]), []).append(piles[name])
    boxes_of = {cell: _in_shelves(members) for cell, members in cells.items()}
    extents = {cell: extent(boxes) for cell, boxes in boxes_of.items()}
    starts = [
        _starts(
            {
                rank: max(extents[cell][axis] for cell in cells if cell[axis] == rank)
                for rank in {cell[axis] for cell in cells}
            }
        )
        for axis in (0, 1)
    ]
    return [
        box
        for (across, up), boxes in boxes_of.items()
        for box in _shifted(boxes, starts[0][across], starts[1][up])
    ]


def _canonical(relation: Relation) -> tuple[str, str, str]:
    """Return a relation as (subject, relation, object), without the relations in `_OPPOSITES`."""
    if opposite := _OPPOSITES.get(relation.relation):
        return relation.object, opposite, relation.subject
    return relation.subject, relation.relation, relation.object


def _supporters(triples: Sequence[tuple[str, str, str]]) -> dict[str, tuple[str, str]]:
    """Return the lower or containing object of each object inside, on or above another, and how.

    The keys of the dictionary are the upper or inner objects. The function ignores a relation that
    would close a cycle.
    """
    below: dict[str, tuple[str, str]] = {}
    for vertical in ("inside", "on-top", "above"):
        for subject, relation, object in triples:
            if relation == vertical and subject not in below and _root(object, below) != subject:
                below[subject] = (object, relation)
    return below


def _root(name: str, below: dict[str, tuple[str, str]]) -> str:
    """Return the lowest object of the pile that contains an object."""
    while name in below:
        name = below[name][0]
    return name


def _pile(name: str, below: dict[str, tuple[str, str]]) -> list[Box]:
    """Return the boxes of an object at (0, 0), and of all objects in, on and above this object."""
    parts = [(how, _pile(other, below)) for other, (at, how) in below.items() if at == name]
    contents: list[Box] = []
    inner = 0.0
    for pile in (pile for how, pile in parts if how == "inside"):
        contents += _shifted(pile, _WALL + inner, _WALL)
        inner += extent(pile)[0] + GAP
    height = HEIGHT + (extent(contents)[1] if contents else 0.0)
    upper: list[Box] = []
    x = 0.0
    for how, pile in parts:
        if how != "inside":
            upper += _shifted(pile, x, height + (GAP if how == "above" else 0.0))
            x += extent(pile)[0] + GAP
    width = max(0.2 * len(name) + 0.6, x - GAP, inner - GAP + 2 * _WALL)
    return [Box(name, 0.0, 0.0, width, height), *contents, *upper]


def _in_shelves(piles: Sequence[list[Box]]) -> list[Box]:
    """Arrange unordered piles in rows. The number of rows is about the number of piles in a row."""
    boxes: list[Box] = []
    length = ceil(sqrt(len(piles)))
    y = 0.0
    for start in range(0, len(piles), length):
        x = 0.0
        shelf: list[Box] = []
        for pile in piles[start : start + length]:
            shelf += _shifted(pile, x, y)
            x += extent(pile)[0] + GAP
        boxes += shelf
        y = extent(shelf)[1] + GAP
    return boxes


def _shifted(boxes: Iterable[Box], x: float, y: float) -> list[Box]:
    return [Box(box.label, box.x + x, box.y + y, box.width, box.height) for box in boxes]


def _starts(extents: dict[int, float]) -> dict[int, float]:
    """Return the start of each column (x) or row (y) from the extents of the columns or rows."""
    ends = accumulate((extents[rank] + 2 * GAP for rank in sorted(extents)), initial=0.0)
    return dict(zip(sorted(extents), ends, strict=False))
