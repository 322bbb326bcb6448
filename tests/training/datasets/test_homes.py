import numpy as np

from tests.training.evaluation.scenes import scene
from training.datasets.homes import NOWHERE, THINGS, home_cases, homes_of

V = 16
STRUCTURE = np.arange(V) == 0


def home(name: str, *rooms: list[int], source: str = "procthor") -> list:
    """The rooms of a home."""
    return [
        scene([0, *classes], source=source, group=name, name=f"{name} {k}")
        for k, classes in enumerate(rooms)
    ]


def test_homes_have_three_rooms_of_a_source_of_homes():
    three = home("a", [1], [2], [3])
    others = home("b", [1], [2]) + home("c", [1], [2], [3], source="sunrgbd")
    assert homes_of([*three, *others]) == [three]


def test_a_thing_is_the_only_one_of_its_class():
    cases = home_cases(home("a", [1, 2, 2], [1, 3], [4]), STRUCTURE)
    taken = {(case.thing, case.room) for case in cases if case.room != NOWHERE}
    assert taken == {(3, 1), (4, 2)}


def test_some_things_were_never_there():
    """400 homes have 1,200 taken things, so one in nine cases is of another class."""
    homes = [home(f"h{k}", [1 + k % 3], [4], [5]) for k in range(400)]
    cases = home_cases([room for one in homes for room in one], STRUCTURE)
    absent = [case for case in cases if case.room == NOWHERE]
    assert 1200 / 9 - 60 < len(absent) < 1200 / 9 + 60  # five standard deviations
    for case in absent:
        classes = {c for room in case.rooms for c in room.instance_classes.tolist()}
        assert case.thing not in classes
        assert case.thing in {1, 2, 3}  # some other home has it
    assert {case.home for case in cases} == set(range(400))


def test_a_large_home_has_a_few_things_that_depend_only_on_the_seed():
    rooms = home("a", list(range(1, 8)), list(range(8, 16)), [])
    first, again = (home_cases(rooms, STRUCTURE, seed=1) for _ in range(2))
    other = home_cases(rooms, STRUCTURE, seed=2)
    things = [[case.thing for case in cases] for cases in (first, again, other)]
    assert len(things[0]) == THINGS
    assert things[0] == things[1] != things[2]
