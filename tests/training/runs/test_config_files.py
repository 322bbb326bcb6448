import pytest

from tests.training.commands import small_config, write_config
from training.datasets.files import DATA
from training.datasets.sources import SOURCES
from training.fit.configuration import ConfigError, source_name
from training.runs.config_files import (
    data_folder,
    load_config,
    shipped_configs,
    shortened,
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


def test_the_shipped_variants_learn_from_the_same_scenes() -> None:
    variants = [load_config(f"places-{variant}") for variant in ("triway", "gbm", "rbm")]
    assert [config.machine.variant for config in variants] == ["triway", "gbm", "rbm"]
    assert len({config.data.model_dump_json() for config in variants}) == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"machine.variant": "rbm", "machine.G": 2}, "machine.G is defined for the Triway only"),
        ({"machine.variant": "rbm", "machine.without": ["S"]}, "a rbm has no weights S"),
        ({"data.rooms": 0}, "data.rooms must be at least 1"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(settings, message) -> None:
    with pytest.raises(ConfigError, match=message):
        with_settings(small_config(), settings)


def test_a_configuration_is_written_and_read_back(tmp_path) -> None:
    changes = {"objects.source_weights": {"rooms": 0.5}, "objects.open_sources": ("rooms",)}
    config = with_settings(small_config(), changes)
    path = write_config(tmp_path / "small.toml", config)
    assert load_config(str(path)) == config


def test_a_shortened_training_keeps_at_least_one_step() -> None:
    tenth = shortened(small_config(), 0.1)
    assert (tenth.objects.steps, tenth.relations.epochs) == (20, 1)
    assert shortened(small_config(), 1e-6).objects.steps == 1


FILES = """
name = "mine"
[data]
sources = {sources}
vocabulary = "vocabulary.json"
[machine]
variant = "rbm"
"""


def test_files_are_read_from_the_folder_of_their_configuration(tmp_path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "mine.toml").write_text(FILES.format(sources='["../day.one.jsonl.gz", "3dssg"]'))
    for reference in (str(folder), str(folder / "mine.toml")):
        config = load_config(reference)
        assert [source_name(source) for source in config.data.sources] == ["day", "3dssg"]
        assert data_folder(reference, config) == folder
        assert data_folder(reference, config, tmp_path) == tmp_path
    assert data_folder("places-rbm", load_config("places-rbm")) == DATA
    with pytest.raises(ConfigError, match=r"missing in .*: \.\./day\.one\.jsonl\.gz, 3dssg"):
        prepare(config, folder)


def test_two_sources_of_one_name_are_refused(tmp_path) -> None:
    (tmp_path / "mine.toml").write_text(FILES.format(sources='["a/day.jsonl", "b/day.jsonl"]'))
    with pytest.raises(ConfigError, match="two sources are called day"):
        load_config(str(tmp_path / "mine.toml"))


def test_stated_terms_change_the_digest() -> None:
    config = load_config("places-rbm")
    assert "terms" not in config.model_dump_json()
    assert with_settings(config, {"data.terms": ""}).digest == config.digest
    assert with_settings(config, {"data.terms": "ours"}).digest != config.digest


def test_terms_of_shipped_sources_and_of_own_files() -> None:
    data = load_config("research-triway").data
    assert terms_of("sunrgbd", data) == (SOURCES["sunrgbd"].terms, True)
    # A file of a known source's name is another source.
    own = data.model_copy(update={"sources": ("sunrgbd.jsonl",), "terms": "ours"})
    assert terms_of("sunrgbd", own) == ("ours", False)
    unstated = own.model_copy(update={"research_only": True, "terms": ""})
    words, research_only = terms_of("sunrgbd", unstated)
    assert research_only
    assert "without stated terms" in words


def test_a_base_gives_the_entries_that_a_file_lacks(tmp_path) -> None:
    path = tmp_path / "mine.toml"
    text = 'base = "places-triway"\nname = "mine"\n[machine]\nunits = 3\n[objects.source_weights]\n'
    path.write_text(text + "alfred = 0.0\n")
    base, mine = load_config("places-triway"), load_config(str(path))
    assert (mine.name, mine.machine.units, mine.machine.states) == ("mine", 3, base.machine.states)
    assert mine.data == base.data
    weights = base.objects.source_weights
    assert mine.objects.source_weights == {**weights, "alfred": 0.0} != weights
    # A base may have a base of its own.
    path.write_text('base = "knowledge-triway"\nname = "mine"\n')
    again = load_config(str(path))
    assert (again.data.sources, again.objects) == (("inventories",), base.objects)
    path.write_text(text.replace("places-triway", "nowhere"))
    with pytest.raises(ConfigError, match=r"mine\.toml: base must be one of .*places-triway"):
        load_config(str(path))
