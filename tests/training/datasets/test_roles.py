import numpy as np
import pytest

from app.scene import ObjectClass, RoleCounts, Vocabulary
from app.scene.roles import IN, ON, UNDER, role_counts
from tests.training.scenes import things
from training.datasets import AnnotatedObject, AnnotatedScene
from training.datasets.roles import count_roles, lift_of

KINDS = [ObjectClass("table lamp", parent="lamp"), ObjectClass("wall", structure=True)]
VOCABULARY = Vocabulary([*map(ObjectClass, ("desk", "bin", "lamp")), *KINDS])
DESK, BIN, LAMP, TABLE_LAMP, WALL = range(5)
Triple = tuple[str, str, str]


def stated(*triples: Triple, source: str = "nr3d", group: str = "g") -> AnnotatedScene:
    """A scene that lists triples of labels (subject, relation, object)."""
    labels = list(dict.fromkeys(label for i, _, j in triples for label in (i, j)))
    listed = tuple((labels.index(i), relation, labels.index(j)) for i, relation, j in triples)
    return AnnotatedScene("s", source, group, None, things(*labels), listed)


def rows_of(counts: RoleCounts) -> dict[tuple[int, int], list[float]]:
    pairs = (divmod(pair, len(VOCABULARY)) for pair in counts.pair.tolist())
    return dict(zip(pairs, counts.counts.tolist(), strict=True))


@pytest.mark.parametrize(
    ("triple", "pair", "role"),
    [
        (("bin", "under", "desk"), (BIN, DESK), UNDER),
        (("bin", "below", "desk"), (BIN, DESK), UNDER),
        (("bin", "on-top", "desk"), (BIN, DESK), ON),
        (("bin", "inside", "desk"), (BIN, DESK), IN),
        (("desk", "contains", "bin"), (BIN, DESK), IN),
    ],
)
def test_words_count_in_the_stated_direction(triple: Triple, pair: tuple[int, int], role: int):
    counts = count_roles([stated(triple)], VOCABULARY)
    expected = np.eye(3)[role].tolist()
    assert rows_of(counts) == {pair: expected}
    assert counts.anchor[DESK].tolist() == expected
    assert not counts.anchor[BIN].any()


def test_other_words_structure_and_pairs_of_one_class_do_not_count():
    scene = stated(
        *(("bin", "left", "desk"), ("bin", "above", "desk")),
        *(("bin", "on-top", "wall"), ("wall", "inside", "bin"), ("bin", "on-top", "spoon")),
    )
    twins = things("bin", "bin")
    nested = AnnotatedScene("t", "nr3d", "g", None, twins, ((0, "inside", 1),))
    silent = AnnotatedScene("u", "nr3d", "g", None, twins)
    counts = count_roles([scene, nested, silent], VOCABULARY)
    assert not len(counts.pair)
    assert not counts.anchor.any()
    assert counts.anchor.shape == (len(VOCABULARY), 3)


def test_near_duplicates_count_once():
    on = ("bin", "on-top", "desk")
    scenes = [stated(on)] * 3 + [stated(on, group="h"), stated(on, source="vsr")]
    scenes.append(stated(("bin", "under", "desk")))
    assert rows_of(count_roles(scenes, VOCABULARY)) == {(BIN, DESK): [3, 1, 0]}


def test_kin_counts_with_half_the_weight():
    """A table lamp is a lamp, and a lamp may be a table lamp."""
    half = [0.5, 0.0, 0.0]
    counts = count_roles([stated(("lamp", "on-top", "desk"))], VOCABULARY)
    assert rows_of(counts) == {(LAMP, DESK): [1, 0, 0], (TABLE_LAMP, DESK): half}
    assert counts.anchor[DESK].tolist() == [1, 0, 0]
    counts = count_roles([stated(("bin", "on-top", "table lamp"))], VOCABULARY)
    assert rows_of(counts) == {(BIN, LAMP): half, (BIN, TABLE_LAMP): [1, 0, 0]}
    assert counts.anchor[[LAMP, TABLE_LAMP]].tolist() == [half, [1, 0, 0]]


@pytest.mark.parametrize(("listed_on", "contains"), [(11, True), (12, False)])
def test_on_a_container_means_in_it(listed_on: int, contains: bool):
    """One "in" among 12 words is a share of .083, and among 13 words a share of .077."""
    scenes = [stated(("lamp", "on-top", "desk"), group=f"g{k}") for k in range(listed_on)]
    scenes += [stated(("bin", "inside", "desk")), stated(("bin", "under", "desk"), group="h")]
    counts = count_roles(scenes, VOCABULARY)
    words = listed_on * np.eye(3)[IN if contains else ON]
    assert role_counts(counts, LAMP, DESK).tolist() == words.tolist()
    assert role_counts(counts, BIN, DESK).tolist() == [0, 1, 1]
    assert counts.anchor[DESK].tolist() == np.add(words, [0, 1, 1]).tolist()


def test_the_lift_is_the_gap_between_an_object_and_the_top_of_its_support():
    desk = AnnotatedObject("desk", "desk", (0.0, 0.0, 0.4), (1.0, 1.0, 0.8))
    lamp = AnnotatedObject("lamp", "lamp", (5.0, 0.0, 0.9), (0.2, 0.2, 0.4))
    assert lift_of(lamp, desk) == pytest.approx(-0.1)
    assert lift_of(lamp, AnnotatedObject("bare", "desk", (0.0, 0.0, 0.4))) is None
    assert lift_of(AnnotatedObject("bare", "lamp"), desk) is None
