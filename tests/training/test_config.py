"""The configurations that come with the package."""

from __future__ import annotations

import pytest

from training.config import load_config, shipped_configs
from training.terms import TERMS


@pytest.mark.parametrize("name", shipped_configs())
def test_shipped_configurations_load(name: str) -> None:
    config = load_config(name)
    assert config.name == name
    assert config.description
    assert all(source in TERMS for source in config.data.sources)


@pytest.mark.parametrize("domain", ["indoor", "everyday"])
def test_the_variants_of_a_domain_learn_from_the_same_scenes(domain: str) -> None:
    """Only then can a benchmark compare them."""
    variants = [load_config(f"{domain}-{variant}") for variant in ("triway", "gbm", "rbm")]
    assert [config.machine.variant for config in variants] == ["triway", "gbm", "rbm"]
    assert len({config.data.model_dump_json() for config in variants}) == 1
