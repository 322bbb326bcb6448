"""The configurations that come with the package."""

from __future__ import annotations

import pytest

from training.config import (
    DATA,
    ConfigError,
    data_folder,
    load_config,
    shipped_configs,
    source_name,
    with_settings,
)
from training.pipeline import prepare
from training.terms import TERMS, terms_of


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


FILES = """
name = "mine"
[data]
sources = {sources}
vocabulary = "vocabulary.json"
[machine]
variant = "rbm"
H2 = 0
[objective]
name = "composite"
"""


def test_files_are_looked_for_beside_their_configuration(tmp_path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "mine.toml").write_text(FILES.format(sources='["../day.one.jsonl.gz", "3dssg"]'))
    for reference in (str(folder), str(folder / "mine.toml")):
        config = load_config(reference)
        assert [source_name(source) for source in config.data.sources] == ["day", "3dssg"]
        assert data_folder(reference, config) == folder
        assert data_folder(reference, config, tmp_path) == tmp_path
    assert data_folder("indoor-rbm", load_config("indoor-rbm")) == DATA
    with pytest.raises(ConfigError, match=r"there is no day\.one\.jsonl\.gz in"):
        prepare(config, folder)


def test_two_sources_of_one_name_are_refused(tmp_path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(FILES.format(sources='["a/day.jsonl", "b/day.jsonl"]'))
    with pytest.raises(ConfigError, match="two sources are called day"):
        load_config(str(path))


def test_terms_change_no_digest_until_they_are_given() -> None:
    config = load_config("indoor-rbm")
    assert "terms" not in config.model_dump_json()
    assert with_settings(config, {"data.terms": ""}).digest == config.digest
    assert with_settings(config, {"data.terms": "ours"}).digest != config.digest


def test_terms_of_ones_own_scenes_are_ones_own(tmp_path) -> None:
    data = load_config("indoor-rbm").data
    assert terms_of("sunrgbd", data).research_only
    own = data.model_copy(update={"sources": ("sunrgbd.jsonl",), "terms": "ours"})
    # A file that happens to be called as a known source is not that source.
    assert terms_of("sunrgbd", own).words == "ours"
    assert not terms_of("sunrgbd", own).research_only
    only = own.model_copy(update={"research_only": True, "terms": ""})
    assert terms_of("sunrgbd", only).research_only
    assert "not stated" in terms_of("sunrgbd", only).words
