"""Propose a vocabulary and a training configuration, with a reason for each entry.

Scenes are drawn of each written place, at least as many in all as there are seen scenes. Every
written thing becomes a class. Few scenes get a small machine, and many scenes a larger one
(docs/decisions/own-scenes.md).
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from app.registry import Example
from app.scene import Vocabulary, label_key
from training.datasets import AnnotatedScene, source_vocabulary, split
from training.datasets.inventories import complete_scene
from training.datasets.splits import FRACTIONS
from training.datasets.vocabulary import coverage, curated_names, is_kind
from training.datasets.written import with_things
from training.domain.look import Facts, Label, count_labels, look
from training.domain.material import Material
from training.evaluation.metrics import FEWEST_GROUPS
from training.fit.configuration import Config, ConfigError
from training.runs.config_files import sections_toml
from training.runs.example_scenes import choose_examples

# Possible minimum numbers of objects of a class. Few scenes need a small one to cover enough.
_MINIMA: Final = (8, 5, 3, 2)
_COVERED: Final = 0.97
# docs/decisions/own-scenes.md gives the measurement behind these two numbers of scenes.
FEWEST_SCENES: Final = 20
FEW_SCENES: Final = 80
_SPLIT_SEEDS: Final = 50
_TOLERANCE: Final = 0.2  # relative deviation of a part of the split from its target share
_MANY_SCENES: Final = 1000  # training scenes for a larger machine (docs/decisions/own-scenes.md)
_DRAWN, _OF_PLACE = 800, 30  # least scenes drawn of all written places together, and of each


@dataclass(frozen=True)
class Proposal:
    """The files and the report that `init` writes."""

    material: Material
    facts: Facts
    labels: tuple[Label, ...]
    minimum: int  # number of objects of a class
    coverage: float  # share of the objects whose label has a class
    vocabulary: Vocabulary
    dropped: tuple[Label, ...]  # names without a class
    values: dict[str, Any]  # sections of the configuration
    config: Config
    reasons: dict[str, str]  # reason for the value of "section.entry"
    parts: dict[str, int]  # number of scenes of each part of the split
    test_groups: int  # number of groups of near-duplicates in the test part
    examples: tuple[Example, ...]

    def written_lines(self) -> list[str]:
        """Return a line about the written places, if there are any."""
        if not (places := self.material.places):
            return []
        each, seen = self.config.data.written, self.material.scenes
        return [
            f"{len(places)} written places, of which training draws {each} scenes each; "
            f"{len(seen)} seen scenes. The lines below count a written place as one complete scene"
        ]

    def read_otherwise(self) -> tuple[list[str], list[str], list[str]]:
        """Return the labels without a class of this name, the kinds, and the renamed room types."""
        words, names = self.vocabulary, curated_names()
        joined, kinds = [], []
        for label in (spelling for entry in self.labels for spelling in entry.spellings):
            if (index := words.index(label)) is None:
                continue
            if label_key(words.labels[index]) != label_key(label):
                joined.append(f"{label} = {words.labels[index]}")
            elif (parent := words.objects[index].parent) is not None:
                kinds.append(f"{label} is a {parent}")
        written = (place.room_type for place in self.material.places)
        rooms = [
            f"{room} = {name}"
            for room in dict.fromkeys([*written, *(x.room_type for x in self.material.scenes)])
            if room and (name := names.canonical_room(room)) and label_key(name) != label_key(room)
        ]
        return joined, kinds, rooms

    @property
    def warning(self) -> str:
        """A warning if the scenes are few, or ""."""
        if self.material.places:
            return ""  # written scenes are drawn in sufficient number
        if self.facts.scenes >= FEW_SCENES and self.test_groups >= FEWEST_GROUPS:
            return ""
        return (
            f"{self.facts.scenes} scenes of {self.facts.groups} groups are few: the test part has "
            f"{self.parts['test']} scenes of {self.test_groups} groups. `publish --promote` needs "
            f"test scenes of {FEWEST_GROUPS} groups, which takes about {FEW_SCENES} scenes of "
            f"{FEW_SCENES // 2} groups. Add scenes of other places, and run init again"
        )

    def toml(self) -> str:
        """Return the configuration as TOML text. A comment above each entry gives the reason."""
        name = self.config.name
        return (
            f"# Proposed by `python -m training init {name}`; you can change every entry.\n"
            "# `python -m training tune` searches for better values on the validation scenes.\n"
            "# The published model contains the scenes of examples.json, for the visual page.\n\n"
            f"{sections_toml(self.values, self.reasons)}"
        )


def propose(name: str, material: Material, sources: Sequence[str], *, terms: str = "") -> Proposal:
    """Analyse scenes and inventories, and propose a vocabulary and a configuration.

    Raises:
        ConfigError: the scenes are too few without an inventory, cannot be split, or lack a
            frequent label.
    """
    seen, places = material.scenes, material.places
    if len(seen) < FEWEST_SCENES and not places:
        raise ConfigError(
            f"{len(seen)} scenes are too few: from fewer than {FEWEST_SCENES} scenes, a model "
            "may learn no more than the frequency of each class. Provide at least "
            f"{FEWEST_SCENES} scenes, better {FEW_SCENES} scenes of {FEW_SCENES // 2} places"
        )
    written = max(_OF_PLACE, math.ceil(max(_DRAWN, len(seen)) / len(places))) if places else 0
    described = [*seen, *map(complete_scene, places)]
    scenes = [*seen, *material.drawn(written)]
    labels = count_labels(described)
    facts = look(described, labels)
    minimum, curated = _choose_vocabulary(scenes, material.things)
    vocabulary = use_frequent_names(curated, scenes)
    if places:
        vocabulary = with_things(vocabulary, material.descriptions)
    seed, parts, test_groups = _split(scenes)
    settings, reasons = _configuration(facts, parts)
    if not seen:
        _know_the_law(settings, reasons)
    reasons |= {
        "data.vocabulary": f"{len(vocabulary)} classes of at least {minimum} mentions, or written; "
        "edit the file to change them",
        "data.split": "the group name fixes the part: you can add scenes, and versions stay "
        "comparable",
        "data.split_seed": f"{parts['train']} training scenes, {parts['validation']} validation "
        f"scenes, {parts['test']} test scenes",
    }
    data: dict[str, Any] = {"sources": list(sources), "vocabulary": "vocabulary.json"}
    data |= {"split": "stable", "split_seed": seed} | ({"terms": terms} if terms else {})
    if places:
        data["written"] = written
        reasons["data.written"] = (
            f"scenes drawn of each written place, {written * len(places)} in all"
        )
    variant = settings["machine"]["variant"].capitalize()
    values = {"name": name, "description": f"{variant} machine over {name} scenes."}
    values |= {"examples": "examples.json", "data": data} | settings
    return Proposal(
        material=material,
        facts=facts,
        labels=tuple(labels),
        minimum=minimum,
        coverage=coverage(curated, described),
        vocabulary=vocabulary,
        dropped=tuple(label for label in labels if vocabulary.index(label.name) is None),
        values=values,
        config=Config.model_validate(values),
        reasons=reasons,
        parts=parts,
        test_groups=test_groups,
        examples=choose_examples(scenes, vocabulary),
    )


def _know_the_law(settings: dict[str, Any], reasons: dict[str, str]) -> None:
    """Change settings for scenes that are all drawn from a table (docs/decisions/own-scenes.md)."""
    settings["machine"]["units"] = 16
    drawn = {"steps": 800, "weight_prior": 0.3, "rate_prior": 2.0, "served_sweeps": 200}
    settings["objects"] |= drawn
    reasons |= {
        "machine.units": "more than for seen scenes: each group of things of a place is a context",
        "objects.steps": "more than for seen scenes, because the priors are weaker",
        "objects.weight_prior": "weaker than for seen scenes: of written places, as many scenes as "
        "needed are drawn",
        "objects.served_sweeps": "generated scenes have the shares of the table",
    }


def _choose_vocabulary(
    scenes: Sequence[AnnotatedScene], required: Sequence[str]
) -> tuple[int, Vocabulary]:
    """Return the largest minimum that covers enough objects, else the smallest; its classes.

    Every `required` label has a class.
    """
    for minimum in _MINIMA:
        try:
            vocabulary = source_vocabulary(scenes, minimum=minimum, required=required)
        except ValueError:
            continue  # no label has so many mentions
        if minimum == _MINIMA[-1] or coverage(vocabulary, scenes) >= _COVERED:
            return minimum, vocabulary
    raise ConfigError("every label occurs only once: training needs labels with more objects")


def use_frequent_names(vocabulary: Vocabulary, scenes: Sequence[AnnotatedScene]) -> Vocabulary:
    """Rename each class to the alias that more than half of its objects have as label, if any.

    A class that becomes a kind, such as visitor chair for chair, keeps its old name and the labels
    of objects. Other kinds of chairs are neither its names nor its kinds.
    """
    key_counts: defaultdict[int | None, Counter[str]] = defaultdict(Counter)
    for thing in (thing for scene in scenes for thing in scene.objects):
        key_counts[vocabulary.index(thing.label)][label_key(thing.label)] += 1
    objects, name_of, narrower = [], {}, set()
    for index, entry in enumerate(vocabulary.objects):
        half = key_counts[index].total() / 2
        common = [x for x in entry.aliases if key_counts[index][label_key(x)] > half]
        name_of[entry.label] = label = common[0] if common else entry.label
        others = [x for x in (entry.label, *entry.aliases) if x != label]
        if is_kind(label, entry.label):
            narrower.add(entry.label)
            counts = key_counts[index]
            others = [x for x in others if x == entry.label or counts[label_key(x)]]
        objects.append(replace(entry, label=label, aliases=tuple(others)))
    for number, entry in enumerate(objects):
        parent = None if entry.parent in narrower else entry.parent
        objects[number] = replace(entry, parent=name_of[parent] if parent else None)
    return Vocabulary(objects, vocabulary.room_types)


def _split(scenes: Sequence[AnnotatedScene]) -> tuple[int, dict[str, int], int]:
    """Return the first seed with parts near their shares, or the best; sizes, test groups."""
    best: tuple[int, dict[str, int], int] | None = None
    smallest, fractions = math.inf, FRACTIONS["stable"]
    for seed in range(_SPLIT_SEEDS):
        scenes_of = split(scenes, seed=seed, protocol="stable")
        sizes: dict[str, int] = {name: len(part) for name, part in scenes_of.items()}
        deviation = max(abs(sizes[p] / (share * len(scenes)) - 1) for p, share in fractions.items())
        if deviation < smallest and all(any(map(_is_informative, x)) for x in scenes_of.values()):
            smallest = deviation
            best = seed, sizes, len({scene.group for scene in scenes_of["test"]})
        if smallest <= _TOLERANCE:
            break
    if best is None:
        raise ConfigError(
            f"{len(scenes)} scenes of {len({scene.group for scene in scenes})} groups cannot be "
            "split: every part needs scenes with at least three different objects. Provide more "
            "scenes or smaller groups"
        )
    return best


def _is_informative(scene: AnnotatedScene) -> bool:
    return len({label_key(thing.label) for thing in scene.objects}) >= 3


def _configuration(facts: Facts, parts: Mapping[str, int]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the sections of the configuration, and the reasons for some of their entries."""
    n = parts["train"]
    is_large = n >= _MANY_SCENES
    machine: dict[str, Any] = {"variant": "triway" if facts.related else "rbm"}
    machine |= {"units": 8, "states": 32 if is_large else 8}
    machine |= {"K": 32 if is_large else 16, "G": 8} if facts.related else {"K": 0}
    machine |= {"N": 512 if is_large else 128, "min_triple_count": 2}
    size = 256 if is_large else 64
    objects = {"steps": 800 if is_large else 300, "batch_size": size, "chains": size}
    values: dict[str, Any] = {"machine": machine, "objects": objects}
    reasons = {
        "machine.variant": "the scenes contain relations or positions"
        if facts.related
        else "the scenes contain no relations or positions: the model learns objects only",
        "machine.states": f"states of a hidden unit: more do not help with {n} training scenes",
        "objects.steps": "more steps do not help, because priors limit the weights",
    }
    if facts.related:
        # An epoch has about eight updates or more, because validation after each epoch takes
        # longer than an update.
        batch = 64 if is_large else max(4, min(32, n // 8))
        updates = math.ceil(n / batch)
        epochs = math.ceil((800 if is_large else 200) / updates)
        values["relations"] = {"epochs": epochs, "batch_size": batch}
        reasons["relations.epochs"] = f"{epochs} epochs of {updates} updates"
    return values, reasons
