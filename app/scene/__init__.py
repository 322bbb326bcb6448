"""Scenes, canonical relations, vocabularies and geometry, independent of any trained model."""

from app.scene.labels import head_of, label_key
from app.scene.relation_table import RelationTable
from app.scene.roles import RoleCounts
from app.scene.scene import (
    PoseRelations,
    Scene,
    SceneObject,
    Viewpoint,
    derive_relations,
    observe,
    to_viewer_frame,
)
from app.scene.spatial_relations import CANONICAL, OPPOSITES, RELATIONS, canonicalise, opposite
from app.scene.vocabulary import ObjectClass, Vocabulary

__all__ = [
    "CANONICAL", "OPPOSITES", "RELATIONS", "ObjectClass", "PoseRelations", "RelationTable",
    "RoleCounts", "Scene", "SceneObject", "Viewpoint", "Vocabulary", "canonicalise",
    "derive_relations", "head_of", "label_key", "observe", "opposite", "to_viewer_frame",
]  # fmt: skip
