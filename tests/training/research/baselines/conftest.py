from __future__ import annotations

import pytest

from tests.training.research.baselines.furnished import furnished
from training.datasets.batches import SceneTensors


@pytest.fixture(scope="session")
def train() -> SceneTensors:
    return furnished(300, seed=1)


@pytest.fixture(scope="session")
def validation() -> SceneTensors:
    return furnished(60, seed=2)
