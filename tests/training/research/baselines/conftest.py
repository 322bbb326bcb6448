from collections.abc import Iterator

import pytest

from tests.training.research.baselines.furnished import furnished
from training.datasets.batches import SceneTensors
from training.research.baselines import object_models


@pytest.fixture(scope="session", autouse=True)
def _short_courses() -> Iterator[None]:
    """A few steps suffice for two kinds of rooms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(object_models, "_STEPS", 60)
        yield


@pytest.fixture(scope="session")
def train() -> SceneTensors:
    return furnished(300, seed=1)


@pytest.fixture(scope="session")
def validation() -> SceneTensors:
    return furnished(60, seed=2)
