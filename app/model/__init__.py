"""The model that answers questions, and its parts: calibration and statistics of training scenes.

`app.registry` reads and writes the parts as the files of an artifact.
"""

from app.model.calibration import (
    AlarmLine,
    AlarmLines,
    Calibration,
    CountSlope,
    CoverageFit,
    FitLimit,
    Judgement,
    LabelFit,
    Misplaced,
    PlaceFit,
    RealFit,
    Sensitivity,
    Sharpness,
    WhereFit,
)
from app.model.possibility import Possibility
from app.model.scene_model import SceneModel, derived_bytes
from app.model.statistics import Counts, Offsets, Places

__all__ = [
    "AlarmLine", "AlarmLines", "Calibration", "CountSlope", "Counts", "CoverageFit", "FitLimit",
    "Judgement", "LabelFit", "Misplaced", "Offsets", "PlaceFit", "Places", "Possibility",
    "RealFit", "SceneModel", "Sensitivity", "Sharpness", "WhereFit",
    "derived_bytes",
]  # fmt: skip
