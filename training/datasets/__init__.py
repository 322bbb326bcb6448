"""Read scenes from files, generate rooms, and encode scenes for the models."""

from training.datasets.encoding import EncodedScene, annotated_classes, encode
from training.datasets.readers import read_scenes
from training.datasets.records import AnnotatedObject, AnnotatedScene, DatasetError
from training.datasets.rooms import generate_rooms, rooms_vocabulary
from training.datasets.splits import split
from training.datasets.vocabulary import source_vocabulary

__all__ = [
    "AnnotatedObject",
    "AnnotatedScene",
    "DatasetError",
    "EncodedScene",
    "annotated_classes",
    "encode",
    "generate_rooms",
    "read_scenes",
    "rooms_vocabulary",
    "source_vocabulary",
    "split",
]
