"""The rows of an ablation: what is read from TOML, and what is refused."""

from __future__ import annotations

from itertools import pairwise

import pytest

from training.fit.configuration import ConfigError
from training.research.ablate import load_rows
from training.runs.config_files import load_config, shipped_files

FULL = load_config("indoor-triway")


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
    return {name for name in ours if ours[name] != theirs[name]}


def test_the_way_to_the_full_model_is_one_step_at_a_time():
    """Steps that bundle are those that the file's head names."""
    full = {row.name: row for row in load_rows(shipped_files("ablations")["indoor-triway"], FULL)}
    way = ["local-form", "no-implications-two-layers", "two-layers"]
    configs = [*(full[name] for name in way), FULL]
    assert [changed(a, b) for a, b in pairwise(configs)] == [
        {"objective.name", "objects.epochs", "machine.N"},
        {"machine.G"},
        {"machine.H2"},
    ]


def test_without_one_part_the_rest_is_as_shipped():
    rows = load_rows(shipped_files("ablations")["indoor-triway"], FULL)
    own = {"local-rbm", "local-gbm"}
    several = {
        row.name: found
        for row in rows
        if row.name not in own
        and not row.name.startswith("local-form")
        and len(found := changed(FULL, row)) > 1
    }
    assert several == {"no-implications-two-layers": {"machine.H2", "machine.G"}}
    assert changed(FULL, next(row for row in rows if row.name == "no-count-dropout")) == {
        "objective.count_dropout"
    }


def rows(tmp_path, text):
    path = tmp_path / "rows.toml"
    path.write_text(text)
    return load_rows(path, FULL)


def test_a_row_changes_what_it_names_and_nothing_else(tmp_path):
    text = (
        '[[row]]\nname = "deep"\nwhat = "two layers"\nchanges = { "machine.H2" = 50 }\n'
        '[[row]]\nname = "open"\nwhat = "open-triway"\nfrom = "open-triway"\n'
    )
    deep, other = rows(tmp_path, text)
    assert (deep.name, deep.description, deep.machine.H2) == ("deep", "two layers", 50)
    assert (deep.objective, deep.training) == (FULL.objective, FULL.training)
    start = load_config("open-triway")
    assert (other.machine, other.training) == (start.machine, start.training)
    assert other.data == FULL.data != start.data


SEED = (
    '[[row]]\nname = "x"\nwhat = ""\n'
    'changes = {{ "machine.form" = "seed", "objective.generative_weight" = 0.0, {settings} }}\n'
)
ONE = '[[row]]\nname = "{name}"\nwhat = ""\n{rest}\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[row]", "is not TOML"),
        ("", "row: Field required"),
        ('[[row]]\nname = "x"', "row.0.what: Field required"),
        (ONE.format(name="x", rest="change = {}"), "row.0.change: Extra inputs"),
        (ONE.format(name="x", rest=""), "x: the row has the same settings as indoor-triway"),
        (ONE.format(name="x y", rest='from = "indoor-rbm"'), "x y: String should match"),
        (ONE.format(name="x", rest='from = "nobody"'), "x: there is no configuration 'nobody'"),
        (ONE.format(name="x", rest='changes = { "a.b" = 1 }'), "x: there is no setting 'a.b'"),
        (ONE.format(name="x", rest='changes = { "machine.H1" = 0 }'), "x: .*machine.H1: Input"),
        (ONE.format(name="x", rest='changes = { "machine.without" = ["g"] }'), "no weights g"),
        (SEED.format(settings='"machine.N" = 0'), "machine.G is defined for the local form"),
        (SEED.format(settings='"machine.G" = 0, "machine.N" = 9'), "machine.N is defined for the"),
        (
            ONE.format(name="indoor-triway", rest='from = "indoor-rbm"'),
            "the name indoor-triway occurs twice",
        ),
        (ONE.format(name="x", rest='from = "indoor-rbm"') * 2, "the name x occurs twice"),
    ],
)
def test_bad_rows_say_what_is_wrong(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        rows(tmp_path, text)
