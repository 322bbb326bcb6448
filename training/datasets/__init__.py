"""Read scenes from files, generate rooms, and encode scenes for the models."""

from training.datasets.encoding import EncodedScene, annotated_classes, encode
from training.datasets.names import Names, curated_names
from training.datasets.readers import READERS, read_scenes
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.roles import count_roles
from training.datasets.rooms import generate_rooms, rooms_vocabulary
from training.datasets.shuffling import shuffle_objects
from training.datasets.splits import FRACTIONS, split, stable_part
from training.datasets.vocabulary import (
    build_indoor_vocabulary,
    build_vocabulary,
    coverage,
    indoor_vocabulary,
    read_vocabulary,
    source_vocabulary,
    vocabulary_json,
    with_typical_sizes,
)

__all__ = [
    "FRACTIONS",
    "READERS",
    "AnnotatedObject",
    "AnnotatedScene",
    "DatasetError",
    "EncodedScene",
    "Names",
    "annotated_classes",
    "build_indoor_vocabulary",
    "build_vocabulary",
    "count_roles",
    "coverage",
    "curated_names",
    "encode",
    "generate_rooms",
    "indoor_vocabulary",
    "read_scenes",
    "read_vocabulary",
    "rooms_vocabulary",
    "shuffle_objects",
    "source_vocabulary",
    "split",
    "stable_part",
    "vocabulary_json",
    "with_typical_sizes",
]
