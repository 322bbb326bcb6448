import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from app.scene import ObjectClass, Vocabulary
from training.datasets import DatasetError
from training.datasets.files import KNOWLEDGE
from training.datasets.inventories import (
    COLUMNS,
    LISTED,
    OPTIONAL,
    THING_COLUMNS,
    Group,
    Inventory,
    Item,
    Place,
    complete_scene,
    detection_rates,
    draw_scene,
    read_inventory,
    read_things,
    shipped_inventory,
    shipped_things,
)
from training.datasets.records import MAX_LISTED, InvalidLinesError
from training.datasets.written import with_things
from training.fit.configuration import Config, DataConfig, MachineConfig
from training.runs.pipeline import prepare

LAMP = "den,study,desk things,.5,lamp,.4,1-3,on-top,desk"
LAMP_ITEM = Item("lamp", 0.4, 1, 3, "on-top", "desk")
DESK = "den,study,basics,1,desk,.8,1,floor,"
BASICS = Group("basics", 1, (Item("desk", 0.8, 1, 1, "floor", ""),))
CUP = "cup,.1,.09,.1,1.3,surface .7 inside .3,no,yes,hand,vessel,mug"
SPORT = (("bicycle", 0.25), ("helmet", 0.5))
VESSEL = "vessel,.2,.2,.2,2,surface 1,no,yes,hand,,"


NINE = (
    *("place", "room_type", "group", "group_share", "label", "share", "count"),
    *("relation", "anchor"),
)


def write(folder: Path, *rows: str, columns=NINE) -> Path:
    path = folder / "table.csv"
    path.write_text("\n".join([",".join(columns), *rows]) + "\n", "utf-8")
    return path


def test_places_are_read_in_order(tmp_path):
    # A blank line, spaces and quotes of a spreadsheet change nothing.
    assert {*COLUMNS, *OPTIONAL} == {*NINE}
    (place,) = read_inventory(
        write(tmp_path, DESK, "", '"den", study ' + LAMP.removeprefix("den,study"))
    ).places
    assert place == Place("den", "study", (BASICS, Group("desk things", 0.5, (LAMP_ITEM,))))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (LAMP.replace("den,", ","), "line 3, column place: is empty"),
        (LAMP.replace("study", "shop"), "line 3, column room_type: is 'study' in other rows"),
        (
            LAMP.replace(",.4,", ",1.4,"),
            "line 3, column share: must be a number above 0 and at most 1",
        ),
        (LAMP.replace("lamp", " "), "line 3, column label: is empty"),
        (LAMP.replace(",.4,", ",nan,"), "line 3, column share: must be a number above 0"),
        (LAMP.replace(".5", "0"), "line 3, column group_share: must be a number above 0"),
        (LAMP.replace("desk things", "basics"), "line 3, column group_share: is 1 in other rows"),
        (LAMP.replace("1-3", "3-1"), "line 3, column count: must be a number such as 2"),
        (LAMP.replace("1-3", "some"), "line 3, column count: must be a number such as 2"),
        (LAMP.replace("on-top", "beside"), "line 3, column relation: must be one of on-top"),
        (LAMP.removesuffix("desk"), "line 3, column anchor: is empty, but the relation is on-top"),
        (LAMP.replace("on-top", "wall"), "line 3, column anchor: must be empty"),
        (LAMP.replace("on-top", ""), "line 3, column anchor: must be empty, because the relation"),
        (
            LAMP.replace(",desk", ",table"),
            "line 3, column anchor: the place 'den' has no row with the label 'table'",
        ),
        (LAMP + ",more", "line 3: the row has 10 values, not 9"),
        ('"' + LAMP, "line 3: is no row"),
        ("x" * 5000, "line 3: the line is longer than"),
    ],
)
def test_errors_name_line_and_column(tmp_path, row, message):
    check_error(read_inventory, write(tmp_path, DESK, row), message)


def check_error(read, path: Path, message: str) -> None:
    with pytest.raises(DatasetError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}, {message}")


def test_empty_cells_have_defaults(tmp_path):
    """A spreadsheet of a country with decimal commas, with empty columns at its right."""
    path = tmp_path / "table.csv"
    rows = ["room_type;label;share;group;group_share;;", "hall;coat;;;;;"]
    rows += ["hall;bicycle;0,25;sport;;;", "hall;helmet;;sport;0,5;;"]
    path.write_text("\ufeff" + "\r\n".join(rows), "utf-8")
    (place,) = read_inventory(path).places
    coats = Group("", 1.0, (Item("coat", 0.5, 1, 1, "", ""),))
    sport = Group("sport", 0.5, tuple(Item(x, y, 1, 1, "", "") for x, y in SPORT))
    assert place == Place("hall", "hall", (coats, sport))
    scene = complete_scene(place)
    assert [thing.label for thing in scene.objects] == ["coat", "bicycle", "helmet", "floor"]
    assert (scene.relations, scene.supported) == ((), ())


def test_placeholders_are_left_out_and_counted(tmp_path):
    rows = [DESK, DESK.replace("desk", "object_7"), LAMP.replace(",desk", ",REMOVE")]
    rows += [DESK.replace("desk", "object_7"), DESK.replace("desk", "n03001627")]
    inventory = read_inventory(write(tmp_path, *rows))
    (place,) = inventory.places
    assert [item.label for _, item in place.items] == ["desk", "lamp"]
    assert [item.relation for _, item in place.items] == ["floor", ""]
    assert inventory.left_out == {"object_7": 2, "n03001627": 1}


def test_all_errors_are_found_and_the_first_32_listed(tmp_path):
    bad = [LAMP.replace(".4", "0"), LAMP + ",more", LAMP.replace("on-top", "beside")]
    path = write(tmp_path, DESK, *bad * 12, LAMP.replace(",desk", ",table"))
    with pytest.raises(InvalidLinesError) as caught:
        read_inventory(path)
    assert (caught.value.count, len(caught.value.errors)) == (37, MAX_LISTED)
    where = [error.where for error in caught.value.errors[:3]]
    assert where == ["line 3, column share", "line 4", "line 5, column relation"]
    assert str(caught.value).startswith(f"{path}, line 3, column share: must be a number above 0")


def test_things_beside_an_inventory_describe_its_classes(tmp_path):
    """Sizes, parents and other names: of the table beside the file, then of the repository."""
    path = write(tmp_path, *(DESK.replace("desk", x) for x in ("cup", "gizmo", "vessel")))
    gizmo = CUP.replace("cup,.1,.09", "gizmo,.4,.1").replace("mug", '"gadget, cup"')
    (tmp_path / "things.csv").write_text("\n".join([",".join(THING_COLUMNS), VESSEL, gizmo]))
    inventory = read_inventory(path)
    assert list(inventory.things) == ["vessel", "gizmo"]
    plain = Vocabulary([ObjectClass(label) for label in ("cup", "gizmo", "vessel")])
    vocabulary = with_things(plain, {**inventory.things, **shipped_things()})
    sizes = dict(zip(vocabulary.labels, vocabulary.sizes.tolist(), strict=True))
    assert sizes["gizmo"] == [0.2, 0.2, 0.1]
    assert sizes["cup"] == [0.097, 0.097, 0.1], "of the repository"
    assert vocabulary.labels[vocabulary.index("gadget")] == "gizmo"
    assert vocabulary.labels[vocabulary.index("cup")] == "cup", "no alias of another class"
    assert vocabulary.broader_labels == (("vessel",), ("vessel",), ())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "line 1: must name the columns room_type, label"),
        (b"place,share\n", "line 1: must name the columns room_type"),
        (b"room_type,label,shares\n", "line 1: has the unknown column 'shares'; known: room_type"),
        (b"label,room_type,label\n", "line 1: names the column label twice"),
        (",".join(NINE).encode() + b"\n", ": has no rows"),
        (",".join(NINE).encode() + b"\n\xff\n", "line 2: is not UTF-8"),
        (None, "no such file"),
    ],
)
def test_a_file_that_is_no_table_is_named(tmp_path, content, message):
    path = tmp_path / "table.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        read_inventory(path)


def test_scenes_follow_the_written_law():
    """Shares of 4,000 scenes are within .04 of the law; five standard errors, p < 1e-5."""
    clock = Item("clock", 0.4, 2, 2, "wall", "")
    place = Place("den", "study", (BASICS, Group("desk things", 0.5, (LAMP_ITEM, clock))))
    rng = np.random.default_rng(3)
    scenes = [draw_scene(place, "one", rng) for _ in range(4000)]
    assert {scene.room_type for scene in scenes} == {"study"}
    counts = [{thing.label: thing.count for thing in scene.objects} for scene in scenes]

    def share(*labels: str) -> float:
        return np.mean([set(labels) <= count.keys() for count in counts])

    assert share("desk") == pytest.approx(0.8, abs=0.04)
    assert share("lamp") == pytest.approx(0.5 * 0.4, abs=0.04)
    # The group is drawn once for both of its things.
    assert share("lamp", "clock") == pytest.approx(0.5 * 0.4 * 0.4, abs=0.04)
    assert share("desk", "lamp") == pytest.approx(0.8 * 0.5 * 0.4, abs=0.04)
    numbers = [count["lamp"] for count in counts if "lamp" in count]
    for number in (1, 2, 3):
        assert np.mean(np.equal(numbers, number)) == pytest.approx(1 / 3, abs=0.09)
    assert {count["clock"] for count in counts if "clock" in count} == {2}


def test_a_detector_lists_a_part_of_each_scene():
    """Large things are listed more often; 4,000 scenes, five standard errors, p < 1e-5."""
    items = (
        Item("table", 1, 1, 1, "floor", ""),
        Item("mug", 1, 1, 1, "on-top", "table"),
        Item("mugs", 1, 2, 2, "inside", "table"),
    )
    place = Place("den", "study", (Group("basics", 1, items),))
    things = {"table": replace(shipped_things()["table"], size=(0.5, 2.0, 0.7))}
    shares = detection_rates(things.values())
    assert shares["table"] == pytest.approx(1 - 0.7 * math.exp(-5))
    inventory = Inventory((place,), things, Counter())
    for whole in inventory.scenes(3, seed=3):
        assert [thing.label for thing in whole.objects] == ["table", "mug", "mugs", "floor"]
    scenes = inventory.detected_scenes(4000, seed=3)
    assert len({scene.scene_id for scene in scenes}) == 4000
    assert {scene.group for scene in scenes} == {"den"}
    names = [[thing.label for thing in scene.objects] for scene in scenes]
    # The size of a mug is unknown.
    for label, share in (("table", shares["table"]), ("mug", LISTED)):
        assert np.mean([label in own for own in names]) == pytest.approx(share, abs=0.04)
    # Both rows of one thing are listed together, and relations keep their ends.
    pairs = (("table", "floor"), ("mug", "table"), ("mugs", "table"))
    for own, scene in zip(names, scenes, strict=True):
        assert ("mug" in own) == ("mugs" in own)
        assert "floor" in own
        related = [(own[i], own[j]) for i, _, j in scene.relations]
        assert related == [pair for pair in pairs if set(pair) <= set(own)]
        assert [own[i] for i in scene.supported] == [subject for subject, _ in related]


def test_things_stand_where_the_table_says():
    table = Item("table", 1, 1, 1, "floor", "")
    items = (
        table,
        Item("mug", 1, 1, 1, "on-top", "tables"),  # the anchor is found in the plural
        Item("lamp", 1, 1, 1, "ceiling", ""),
        Item("book", 1, 1, 1, "inside", "shelf"),
        Item("shelf", 1e-9, 1, 1, "wall", ""),
    )
    place = Place("den", "study", (Group("basics", 1, items),))
    scene = draw_scene(place, "one", np.random.default_rng(0))
    names = [thing.label for thing in scene.objects]
    assert names == ["table", "mug", "lamp", "book", "floor"]
    told = {(names[i], relation, names[j]) for i, relation, j in scene.relations}
    assert told == {("table", "on-top", "floor"), ("mug", "on-top", "table")}
    assert [names[i] for i in scene.supported] == ["table", "mug", "lamp"]


def test_a_seed_gives_the_same_scenes():
    own = shipped_inventory()
    inventory = replace(own, places=own.places[:3])
    for draw in (inventory.scenes, inventory.detected_scenes):
        assert draw(2, seed=1) == draw(2, seed=1)
        assert draw(2, seed=1) != draw(2, seed=2)


def test_places_are_a_data_source_without_a_data_folder(tmp_path):
    data = DataConfig(sources=("inventories",), vocabulary="rooms", written=2)
    machine = MachineConfig(variant="triway")
    scenes = prepare(Config(name="written", data=data, machine=machine), tmp_path)
    assert scenes.counts == {"inventories": 2 * 265}
    groups = [{scene.group for scene in part} for part in scenes.parts.values()]
    assert sum(map(len, groups)) == len(set.union(*groups)) == 265
    assert "surgical light" in {x for scene in scenes.parts["train"] for x in scene.unknown}
    with pytest.raises(ValidationError, match=r"data\.written must be at least 1"):
        Config(name="written", data=DataConfig(sources=("inventories",)), machine=machine)


def test_things_are_read(tmp_path):
    path = write(tmp_path, CUP.replace("mug", '"mug, coffee cup"'), VESSEL, columns=THING_COLUMNS)
    cup = read_things(path)["cup"]
    assert cup.size == (0.1, 0.09, 0.1)
    assert cup.stands == {"surface": 0.7, "inside": 0.3}
    assert (cup.surface, cup.container, cup.carried) == ("no", "yes", "hand")
    assert (cup.parent, cup.other_names) == ("vessel", ("mug", "coffee cup"))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (CUP.replace("cup,.1", "cup,0"), "line 3, column long: must be a number above 0"),
        (CUP.replace(" .3", " .4"), "line 3, column stands: must list shares that add up to 1"),
        (CUP.replace("inside .3", "sky .3"), "line 3, column stands: must list shares"),
        (CUP.replace("inside .3", "inside"), "line 3, column stands: must list shares"),
        (CUP.replace("hand", "robot"), "line 3, column carried: must be one of hand"),
        (CUP.replace("vessel", "mug"), "line 3, column parent: 'mug' has no row"),
        (CUP.replace("vessel", "cup"), "line 3, column parent: the parents of 'cup' lead back"),
        (CUP.replace("cup,", "Vessels,", 1), "line 3, column label: 'Vessels' has two rows"),
    ],
)
def test_errors_of_things_name_line_and_column(tmp_path, row, message):
    check_error(read_things, write(tmp_path, VESSEL, row, columns=THING_COLUMNS), message)


def test_a_long_loop_of_parents_is_found(tmp_path):
    rows = [CUP.replace("cup,", f"{a},", 1).replace("vessel", b) for a, b in ("ab", "bc", "ca")]
    with pytest.raises(DatasetError, match="the parents of 'a' lead back to 'a'"):
        read_things(write(tmp_path, *rows, columns=THING_COLUMNS))


def test_the_shipped_tables_are_valid():
    inventory = read_inventory(KNOWLEDGE / "inventories.csv")
    places = inventory.places
    assert inventory.things == shipped_things()
    assert not inventory.left_out
    assert len(places) == 265
    assert sum(1 for place in places for _ in place.items) == 32_680
    assert len(shipped_things()) == 1_859
