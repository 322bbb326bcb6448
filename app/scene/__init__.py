"""Scenes, canonical relations, vocabularies and geometry, independent of any trained model."""

from app.scene.geometry import PoseRelations, Viewpoint, derive_relations, to_viewer_frame
from app.scene.labels import head_of, label_key
from app.scene.relations import (
    CANONICAL,
    OPPOSITES,
    RELATIONS,
    canonicalise,
    contradiction,
    opposite,
)
from app.scene.roles import RoleCounts
from app.scene.scene import (
    ClassEvidence,
    Scene,
    SceneObject,
    instance_evidence,
    observe,
    pool_instances,
)
from app.scene.vocabulary import ObjectClass, Vocabulary

__all__ = [
    "CANONICAL",
    "OPPOSITES",
    "RELATIONS",
    "ClassEvidence",
    "ObjectClass",
    "PoseRelations",
    "RoleCounts",
    "Scene",
    "SceneObject",
    "Viewpoint",
    "Vocabulary",
    "canonicalise",
    "contradiction",
    "derive_relations",
    "head_of",
    "instance_evidence",
    "label_key",
    "observe",
    "opposite",
    "pool_instances",
    "to_viewer_frame",
]
