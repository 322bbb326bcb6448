"""Calibration of room types: their sharpness, rare types, and limits of generated scenes."""

import numpy as np
import pytest
import torch

from app.questions import rooms
from app.registry import Sharpness
from tests.questions.artifacts import LABELS, larger_artifact
from tests.training.evaluation.scenes import WIDE, scene, tensors
from training.evaluation.asking import of_classes
from training.fit import calibrate_rooms
from training.fit.calibrate_objects import recalibrated
from training.fit.calibrate_rooms import fit_rooms, rare_rooms, smallest_scenes, written_rooms

V = len(LABELS)
STRUCTURE = torch.arange(V) == V - 1
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
        fitted = fit_rooms(model, tensors(made, V), STRUCTURE)
    for n in (1, 6):
        assert fitted.of(n) == pytest.approx(sharpness.of(n), abs=0.15)


def test_few_scenes_leave_the_room_types_as_they_are(model):
    few = [scene([0, 1], room=0)] * 19 + [scene([0, 1])] * 50
    assert fit_rooms(model, tensors(few, V), STRUCTURE) == Sharpness()


def test_written_room_types_are_those_without_other_scenes():
    rooms = (("inventories", 0), ("inventories", 1), ("virtualhome", 1), ("virtualhome", 2))
    scenes = [scene([0, 1], room=room, source=source) for source, room in rooms]
    scenes.append(scene([0, 1], source="inventories"))
    assert written_rooms(tensors(scenes, V)) == (0,)


def test_rare_room_types_are_those_that_samples_do_not_resemble(model):
    """The type 0 has too few scenes; scenes of the type 1 are samples, or unlike all samples."""
    samples = calibrate_rooms._samples(model, 1, seed=5)[:20]
    like = [scene(np.flatnonzero(row).tolist() or [0], room=1) for row in samples]
    unlike = [scene([int(np.argmin(samples[:, : V - 1].mean(0)))], room=1)] * 20
    few, enough = [scene(OFFICE, room=0)] * 9, [scene(OFFICE, room=0)] * 50
    assert rare_rooms(model, tensors(few + like, V), STRUCTURE) == (0,)
    assert rare_rooms(model, tensors(enough + like, V), STRUCTURE) == ()
    assert rare_rooms(model, tensors(enough + unlike, V), STRUCTURE) == (1,)


def test_the_fit_does_not_see_structure(model):
    """Scenes with and without a wall give the same sharpness."""

    def fit(structure: list[int]) -> Sharpness:
        made = [
            scene([k % 6, (k + 1) % 6, *structure], room=k % 2, name=f"room {k}") for k in range(60)
        ]
        return fit_rooms(model, tensors(made, V), STRUCTURE)

    both = [fit([]), fit([V - 1])]
    assert both[0] == both[1]
    assert both[0] != Sharpness()


def test_the_smallest_scenes_are_those_of_their_room_type():
    """Of a type of 20 scenes its own size, of fewer that of all; structure does not count."""
    large, small = scene([0, 1, 2, 3, 4], room=0), scene([1, 2, 3], room=1)
    data = tensors([large] * 20 + [small] * 19, WIDE)
    structure = torch.zeros(data.v.shape[1], dtype=torch.bool)
    assert smallest_scenes(data, structure, 3) == (5, 3, 3, 3)
    structure[0] = True
    assert smallest_scenes(data, structure, 2) == (4, 3, 3)
    assert smallest_scenes(tensors([large] * 20 + [small], WIDE), structure, 2) == (4, 4, 4)
