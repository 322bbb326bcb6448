"""Pictures of generated scenes. Needs matplotlib, which comes with the group `training`."""

from __future__ import annotations

from math import ceil, sqrt
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from scene_client.layout import GAP, Box, arrange, extent
from scene_client.schemas import GenerateAnswer, GeneratedScene

# Told apart by more than their colour: each has its own dashes. On-top is drawn as lying on top.
_STYLES: Final = {
    "left": ("#1f5fa8", "-"),
    "front": ("#b34700", "--"),
    "above": ("#2d7a2d", ":"),
}
# Of a unit of the layout, in inches: labels in this size of type fit their boxes.
_UNIT: Final = 0.32
_POINTS: Final = 7
# Around each scene, in units: its title above, its legend below.
_MARGIN: Final = 4.0
_MAX_PIXELS: Final = 6000


def draw(answer: GenerateAnswer, path: Path) -> None:
    """Write a picture of every scene; the ending of ``path`` says in which format.

    Raises:
        ValueError: matplotlib knows no such format.
        OSError: the file cannot be written.
    """
    boxes = [arrange(scene.objects, scene.relations) for scene in answer.scenes]
    columns = ceil(sqrt(len(boxes)))
    extents = [extent(found) for found in boxes]
    widths = [max(w for w, _ in extents[n::columns]) + _MARGIN for n in range(columns)]
    heights = [
        max(h for _, h in extents[start : start + columns]) + _MARGIN
        for start in range(0, len(boxes), columns)
    ]
    size = (sum(widths) * _UNIT, sum(heights) * _UNIT)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(len(heights), columns, width_ratios=widths, height_ratios=heights)
    for place, (scene, found) in enumerate(zip(answer.scenes, boxes, strict=True)):
        axes = figure.add_subplot(grid[place // columns, place % columns])
        axes.set_title(f"scene {place + 1} of seed {answer.seed}", fontsize=_POINTS + 2)
        _draw(axes, scene, found)
    figure.savefig(path, dpi=min(150.0, _MAX_PIXELS / max(size)))


def _draw(axes: Axes, scene: GeneratedScene, boxes: list[Box]) -> None:
    axes.set_axis_off()
    axes.set_aspect("equal")
    for box in boxes:
        axes.add_patch(
            FancyBboxPatch(
                (box.x, box.y),
                box.width,
                box.height,
                boxstyle="round,pad=0,rounding_size=0.15",
                facecolor="#f2f2f2",
                edgecolor="#333333",
                linewidth=0.8,
                zorder=2,
            )
        )
        middle = (box.x + box.width / 2, box.y + box.height / 2)
        # A dollar sign would begin mathematics.
        text = box.label.replace("$", r"\$")
        axes.text(*middle, text, ha="center", va="center", fontsize=_POINTS, zorder=3)
    named = {box.label: box for box in boxes}
    used = set()
    for relation in scene.relations:
        subject, object = named.get(relation.subject), named.get(relation.object)
        if subject is not None and object is not None and relation.relation in _STYLES:
            used.add(relation.relation)
            _join(axes, subject, object, relation.relation)
    for name in sorted(used):
        color, dashes = _STYLES[name]
        axes.plot([], [], color=color, linestyle=dashes, label=name)
    if used:
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, fontsize=_POINTS, frameon=False
        )
    width, height = extent(boxes)
    axes.set_xlim(-GAP, width + GAP)
    axes.set_ylim(-GAP, height + GAP)


def _join(axes: Axes, subject: Box, object: Box, relation: str) -> None:
    color, dashes = _STYLES[relation]
    axes.plot(
        [subject.x + subject.width / 2, object.x + object.width / 2],
        [subject.y + subject.height / 2, object.y + object.height / 2],
        color=color,
        linestyle=dashes,
        linewidth=0.7,
        alpha=0.5,
        zorder=1,
    )
