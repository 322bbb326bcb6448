"""Published models: their file format, the store of models, and loaded snapshots of the store."""

from app.registry.artifact import Artifact, load_artifact, write_artifact
from app.registry.counts import Counts
from app.registry.description import (
    AlarmLine,
    AlarmLines,
    Calibration,
    CountSlope,
    CoverageFit,
    DataSource,
    Description,
    Example,
    FitLimit,
    Judgement,
    Metric,
    Misplaced,
    PlaceFit,
    Sensitivity,
    Sharpness,
    VocabularyEntry,
)
from app.registry.errors import ArtifactError, RegistryError, StoreError
from app.registry.manifest import Manifest
from app.registry.model_set import ModelSet, load_model_set
from app.registry.offsets import Offsets
from app.registry.places import Places
from app.registry.references import AliasTarget
from app.registry.store import DEFAULT_STORE, Store, StoreState

__all__ = [
    "DEFAULT_STORE", "AlarmLine", "AlarmLines", "AliasTarget", "Artifact", "ArtifactError",
    "Calibration", "CountSlope", "Counts", "CoverageFit", "DataSource", "Description", "Example",
    "FitLimit", "Judgement", "Manifest", "Metric", "Misplaced", "ModelSet", "Offsets", "PlaceFit",
    "Places", "RegistryError", "Sensitivity", "Sharpness", "Store", "StoreError", "StoreState",
    "VocabularyEntry", "load_artifact", "load_model_set", "write_artifact",
]  # fmt: skip
