"""The configurations that come with the package."""

from __future__ import annotations

import pytest

from training.datasets.files import DATA
from training.datasets.sources import SOURCES
from training.fit.configuration import Config, ConfigError, source_name
from training.runs.config_files import (
    config_toml,
    data_folder,
    load_config,
    shipped_configs,
    with_settings,
)
from training.runs.pipeline import prepare
from training.runs.publish import terms_of


@pytest.mark.parametrize("name", shipped_configs())
def test_shipped_configurations_load(name: str) -> None:
    config = load_config(name)
    assert config.name == name
    assert config.description
    assert all(source in SOURCES for source in config.data.sources)


def test_the_indoor_variants_learn_from_the_same_scenes() -> None:
    """Only then can a benchmark compare them."""
    variants = [load_config(f"indoor-{variant}") for variant in ("triway", "gbm", "rbm")]
    assert [config.machine.variant for config in variants] == ["triway", "gbm", "rbm"]
    assert len({config.data.model_dump_json() for config in variants}) == 1


def phases(objective="relations", form="local", epochs=3):
    return {
        "name": "phases",
        "data": {"sources": ["rooms"], "rooms": 10},
        "machine": {"variant": "triway", "form": form},
        "objective": {"name": objective},
        "objects": {"epochs": epochs},
    }


def test_the_object_phase_needs_the_local_form() -> None:
    """In the seed form relations act on the objects."""
    assert Config.model_validate(phases()).objects.epochs == 3
    with pytest.raises(ValueError, match=r"objects\.epochs is defined for the local form only"):
        Config.model_validate(phases("composite", form="seed"))


def test_the_relation_objective_needs_the_object_phase() -> None:
    assert Config.model_validate(phases("composite", epochs=0)).objects.epochs == 0
    with pytest.raises(ValueError, match="trains no objects"):
        Config.model_validate(phases(epochs=0))


def test_the_phases_are_written_and_read_back(tmp_path) -> None:
    path = tmp_path / "phases.toml"
    config = with_settings(Config.model_validate(phases()), {"objective.word_weight": 0.5})
    path.write_text(config_toml(config))
    assert load_config(str(path)) == config


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
    with pytest.raises(ConfigError, match=r"missing in .*: \.\./day\.one\.jsonl\.gz, 3dssg"):
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


def test_terms_of_the_users_own_files() -> None:
    data = load_config("indoor-rbm").data
    assert terms_of("sunrgbd", data) == (SOURCES["sunrgbd"].terms, True)
    # A file of a known source's name is another source.
    own = data.model_copy(update={"sources": ("sunrgbd.jsonl",), "terms": "ours"})
    assert terms_of("sunrgbd", own) == ("ours", False)
    words, research_only = terms_of(
        "sunrgbd", own.model_copy(update={"research_only": True, "terms": ""})
    )
    assert research_only
    assert "without stated terms" in words
