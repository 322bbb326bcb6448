import pytest

from training.fit.configuration import ConfigError
from training.research.benchmark import load_rows
from training.runs.config_files import load_config, shipped_files

FULL = load_config("places-triway")


@pytest.mark.parametrize("name", shipped_files("ablations"))
def test_shipped_rows_learn_from_the_scenes_of_the_full_model(name):
    full = load_config(name)
    rows = load_rows(shipped_files("ablations")[name], full)
    assert {row.data for row in rows} == {full.data.model_copy()}
    assert all(row.description for row in rows)
    # Each is another model, not another name.
    changed = [row.model_copy(update={"name": "", "description": ""}) for row in (full, *rows)]
    assert len({row.digest for row in changed}) == len(changed)


def settings(config):
    """Every entry by its name, as in "machine.G"."""
    dumped = config.model_dump(exclude={"name", "description", "examples", "data"})
    return {f"{part}.{name}": x for part, some in dumped.items() for name, x in some.items()}


def changed(before, after):
    ours, theirs = settings(before), settings(after)
    return {name for name in ours | theirs if ours.get(name) != theirs.get(name)}


def rows(tmp_path, text):
    path = tmp_path / "rows.toml"
    path.write_text(text)
    return load_rows(path, FULL)


def test_a_row_changes_only_its_settings(tmp_path):
    text = (
        '[[row]]\nname = "wide"\nwhat = "50 units"\nchanges = { "machine.units" = 50 }\n'
        '[[row]]\nname = "open"\nwhat = "knowledge-triway"\nfrom = "knowledge-triway"\n'
    )
    wide, other = rows(tmp_path, text)
    assert (wide.name, wide.description, wide.machine.units) == ("wide", "50 units", 50)
    assert changed(FULL, wide) == {"machine.units"}
    start = load_config("knowledge-triway")
    assert not changed(start, other)
    assert other.data == FULL.data != start.data


ONE = '[[row]]\nname = "{name}"\nwhat = ""\n{rest}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[row]", "is not TOML"),
        ("", "row: Field required"),
        ('[[row]]\nname = "x"', "row.0.what: Field required"),
        (ONE.format(name="x", rest="change = {}"), "row.0.change: Extra inputs"),
        (ONE.format(name="x", rest=""), "x: the row has the same settings as places-triway"),
        (ONE.format(name="x y", rest='from = "places-rbm"'), "x y: String should match"),
        (ONE.format(name="x", rest='from = "nobody"'), "x: there is no configuration 'nobody'"),
        (ONE.format(name="x", rest='changes = { "a.b" = 1 }'), "x: there is no setting 'a.b'"),
        (ONE.format(name="x", rest='changes = { "machine.K" = -1 }'), "x: .*machine.K: Input"),
        (ONE.format(name="x", rest='changes = { "machine.without" = ["g"] }'), "no weights g"),
        (
            ONE.format(name="places-triway", rest='from = "places-rbm"'),
            "the name places-triway occurs twice",
        ),
        (ONE.format(name="x", rest='from = "places-rbm"') * 2, "the name x occurs twice"),
    ],
)
def test_invalid_rows_are_refused_with_the_reason(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        rows(tmp_path, text)
