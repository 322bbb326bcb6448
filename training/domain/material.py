"""The input files of `init` and `adapt`: files of scenes, and written inventories."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from training.datasets import AnnotatedScene, DatasetError
from training.datasets.inventories import Inventory, Place, Thing, read_inventory, with_shipped
from training.datasets.jsonl import scan_jsonl
from training.datasets.readers import guess_format, read_scenes
from training.datasets.records import InvalidLinesError
from training.datasets.sources import is_inventory
from training.datasets.vocabulary import plain_scenes
from training.fit.configuration import ConfigError, source_name


@dataclass(frozen=True)
class Material:
    """The content of files."""

    files: tuple[tuple[AnnotatedScene, ...], ...]  # scenes of each file, with plain labels
    inventories: Mapping[str, Inventory]  # by the name of their data source
    left_out: Counter[str]  # labels that name no kind of object

    @property
    def scenes(self) -> list[AnnotatedScene]:
        """The scenes of all files of scenes."""
        return [scene for file in self.files for scene in file]

    @property
    def places(self) -> list[Place]:
        """The written places."""
        return [place for inventory in self.inventories.values() for place in inventory.places]

    @property
    def things(self) -> list[str]:
        """The labels of all written things."""
        return [item.label for place in self.places for _, item in place.items]

    @property
    def descriptions(self) -> Mapping[str, Thing]:
        """The described things by label: of the tables beside the inventories, then the shipped."""
        return with_shipped(inventory.things for inventory in self.inventories.values())

    def drawn(self, each: int) -> list[AnnotatedScene]:
        """Draw a number of scenes of each written place. Training draws others, of the same law."""
        return [
            replace(scene, source=name)
            for name, inventory in self.inventories.items()
            for scene in inventory.scenes(each, seed=0)
        ]


def read_material(paths: Iterable[Path], *, recorded: bool = False) -> Material:
    """Read files of scenes and inventories. With `recorded`, every file of scenes is JSONL.

    The result also counts the labels that name no kind of object, such as "item".

    Raises:
        DatasetError: a file cannot be read, or has no scene.
        InvalidLinesError: lines of a file are invalid.
        ConfigError: two inventories have the same name.
    """
    files, inventories, left_out = [], dict[str, Inventory](), Counter[str]()
    for path in paths:
        if is_inventory(path.name):
            if (name := source_name(path.name)) in inventories:
                raise ConfigError(f"two sources are called {name}: rename a file")
            inventories[name] = inventory = read_inventory(path)
            left_out.update(inventory.left_out)
        else:
            scenes, empty = plain_scenes(_read_scenes(path, recorded))
            files.append(tuple(scenes))
            left_out.update(empty)
    return Material(tuple(files), inventories, left_out)


def _read_scenes(path: Path, recorded: bool) -> list[AnnotatedScene]:
    """Return the scenes of a file. Raise all errors of its lines together."""
    is_jsonl = recorded or guess_format(path) == "jsonl"
    lines = list(scan_jsonl(path) if is_jsonl else read_scenes(path))
    errors = [line for line in lines if isinstance(line, DatasetError)]
    if len(errors) > 1:
        raise InvalidLinesError(path, errors, len(errors))
    if errors:
        raise errors[0]
    if not lines:
        raise DatasetError(path, "", "the file contains no scene")
    return [line for line in lines if isinstance(line, AnnotatedScene)]
