import numpy as np
import pytest

from app.model import Sharpness
from app.model.calibration import NO_LIMIT
from app.questions import rooms
from app.questions.generate import is_within_limits, room_fit
from tests.questions.artifacts import LABELS, larger_artifact
from tests.training.evaluation.scenes import scene, tensors
from training.evaluation.parts import of_classes
from training.fit import calibrate_rooms
from training.fit.regression import recalibrated

V = len(LABELS)

OFFICE = [2, 3, 4]


@pytest.fixture(scope="module")
def model():
    return larger_artifact("triway-states")


@pytest.mark.parametrize("sharpness", [Sharpness(slope=0.4), Sharpness(slope=2.0, log_count=-0.5)])
def test_the_sharpness_that_draws_the_room_types_is_fitted(model, sharpness):
    """Room types drawn from p^s; 4,000 lists determine s within .15 for one and for six classes."""
    rng, drawn = np.random.default_rng(0), recalibrated(model, rooms=sharpness)
    made = []
    for _ in range(4000):
        classes = np.sort(rng.permutation(V - 1)[: rng.integers(1, 7)])
        answer = rooms(drawn, of_classes(classes.tolist()), details=False)["room_types"]
        p = {entry["room_type"]: entry["probability"] for entry in answer}
        types = [p[name] for name in model.vocabulary.room_types]
        made.append(
            scene(classes.tolist(), room=int(rng.choice(len(types), p=types / np.sum(types))))
        )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate_rooms, "_LENGTHS", ())  # whole scenes only
        fitted = calibrate_rooms.fit_rooms(model, tensors(made, V))
    for n in (1, 6):
        assert fitted.of(n) == pytest.approx(sharpness.of(n), abs=0.15)


def test_few_scenes_leave_the_room_types_as_they_are(model):
    few = [scene([0, 1], room=0)] * 19 + [scene([0, 1])] * 50
    assert calibrate_rooms.fit_rooms(model, tensors(few, V)) == Sharpness()


def test_written_room_types_are_those_without_other_scenes():
    rooms = (("inventories", 0), ("inventories", 1), ("virtualhome", 1), ("virtualhome", 2))
    scenes = [scene([0, 1], room=room, source=source) for source, room in rooms]
    scenes.append(scene([0, 1], source="inventories"))
    assert calibrate_rooms.written_rooms(tensors(scenes, V)) == (0,)


def test_rare_room_types_are_those_that_samples_do_not_resemble(model):
    """The type 0 has too few scenes; scenes of the type 1 are samples, or unlike all samples."""
    samples = calibrate_rooms._samples(model, 1, seed=5)[:20]
    like = [scene(np.flatnonzero(row).tolist() or [0], room=1) for row in samples]
    unlike = [scene([int(np.argmin(samples[:, : V - 1].mean(0)))], room=1)] * 20
    few, enough = [scene(OFFICE, room=0)] * 9, [scene(OFFICE, room=0)] * 50
    assert calibrate_rooms.rare_rooms(model, tensors(few + like, V)) == (0,)
    assert calibrate_rooms.rare_rooms(model, tensors(enough + like, V)) == ()
    assert calibrate_rooms.rare_rooms(model, tensors(enough + unlike, V)) == (1,)


def test_the_fit_does_not_see_structure(model):
    """Scenes with and without a wall give the same sharpness."""

    def fit(structure: list[int]) -> Sharpness:
        made = [
            scene([k % 6, (k + 1) % 6, *structure], room=k % 2, name=f"room {k}") for k in range(60)
        ]
        return calibrate_rooms.fit_rooms(model, tensors(made, V))

    both = [fit([]), fit([V - 1])]
    assert both[0] == both[1]
    assert both[0] != Sharpness()


def limits_of(model, scenes):
    return calibrate_rooms.limits(model, tensors(scenes, V))


def test_limits_are_those_of_short_lists_of_a_room_type(model):
    """Three of ten classes: two of seven, one of four. A type of 19 scenes has those of all."""
    large, small = scene([*range(7), V - 1], room=0), scene([1, 2, 3, 4], room=1)
    found = limits_of(model, [large] * 20 + [small] * 20)
    assert found["smallest"] == (2, 1, 1)
    few = limits_of(model, [large] * 20 + [small] * 19)
    assert few["smallest"] == (2, 1, 1)
    assert few["room_fit"] == (found["room_fit"][0], NO_LIMIT)
    assert limits_of(model, [large] * 20 + [small])["smallest"] == (2, 2, 2)


def test_sources_have_equal_weight_in_the_limits(model):
    """Two small scenes of 102, but all those of a source."""
    large, small = scene([*range(7)], room=0, source="house"), scene([1, 2, 3], room=0)
    assert limits_of(model, [large] * 100 + [small] * 2)["smallest"][0] == 1
    small = scene([1, 2, 3], room=0, source="house")
    assert limits_of(model, [large] * 100 + [small] * 2)["smallest"][0] == 2


def test_limits_are_those_of_whole_rooms(model):
    """Procedural kitchens and camera frames do not count beside them, but they do alone."""
    whole = [scene([*range(7)], room=0, source="virtualhome")] * 20
    frames = [scene([1, 2], room=0, source=source) for source in ("procthor", "sunrgbd")] * 20
    assert limits_of(model, whole + frames) == limits_of(model, whole)
    assert limits_of(model, frames)["smallest"][0] == 1


def test_the_fit_of_a_room_type_is_the_low_quantile(model):
    """Of lists of one class; a tenth of the lists has another class."""
    fits = [room_fit(model, [k], 1) for k in range(3)]
    low, high = int(np.argmin(fits)), int(np.argmax(fits))
    scenes = [scene([high], room=1)] * 18 + [scene([low], room=1)] * 2
    limit = limits_of(model, scenes)["room_fit"][1]
    assert (limit.intercept, limit.log_count) == (pytest.approx(fits[low], abs=1e-4), 0.0)
    limited = recalibrated(model, **limits_of(model, [scene([high], room=1)] * 20))
    assert is_within_limits(limited, [high], 1)
    assert not is_within_limits(limited, [low], 1)
    assert limited.calibration.rare_rooms == model.calibration.rare_rooms


def test_the_limit_of_the_fit_depends_on_the_length_of_the_list(model, monkeypatch):
    """Lists of 1 to 4 classes, whose fit is a line in the log of their length."""

    def fit(_, classes, room):
        return 2 * np.log(len(classes)) - room

    monkeypatch.setattr(calibrate_rooms, "room_fit", fit)
    limit = limits_of(model, [scene([0, 1, 2, 3], room=1)] * 100)["room_fit"][1]
    assert (limit.intercept, limit.log_count) == pytest.approx((-1, 2), abs=1e-4)
    few = limits_of(model, [scene([0, 1, 2, 3], room=1)] * 99)["room_fit"][1]
    assert (few.intercept, few.log_count) == (-1, 0)
    assert limit.of(4) == pytest.approx(fit(model, [0, 1, 2, 3], 1), abs=1e-3)


def test_the_limit_admits_whole_rooms_whose_fit_grows_no_more(model, monkeypatch):
    """A line through the quantiles would be above the fit of all whole rooms."""
    monkeypatch.setattr(calibrate_rooms, "room_fit", lambda _, x, __: min(np.log(len(x)), 0.7))
    limit = limits_of(model, [scene([0, 1, 2, 3], room=1)] * 100)["room_fit"][1]
    assert limit.log_count > 0.3
    assert limit.of(4) == pytest.approx(0.7, abs=1e-3)
    assert all(limit.of(n) <= min(np.log(n), 0.7) for n in (1, 2, 3, 4))
