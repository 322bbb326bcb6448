"""Published models: their file format, the store of models, and loaded snapshots of the store."""

from app.registry.artifact import Artifact, load_artifact, write_artifact
from app.registry.description import DataSource, Description, Example, Metric, VocabularyEntry
from app.registry.errors import ArtifactError, RegistryError, StoreError
from app.registry.manifest import Manifest
from app.registry.model_set import ModelSet, load_model_set
from app.registry.references import AliasTarget
from app.registry.store import DEFAULT_STORE, Store, StoreState

__all__ = [
    "DEFAULT_STORE", "AliasTarget", "Artifact", "ArtifactError", "DataSource", "Description",
    "Example", "Manifest", "Metric", "ModelSet", "RegistryError", "Store", "StoreError",
    "StoreState", "VocabularyEntry", "load_artifact", "load_model_set", "write_artifact",
]  # fmt: skip
