import numpy as np
import pytest

from app.model.calibration import KINDS, CountSlope, PlaceFit
from app.questions.posterior import Posterior
from tests.questions.artifacts import larger_artifact, scene_of
from training.evaluation.asking import missing_log_p_at
from training.research.shares import VARIANTS, at_a_place, misplaced, without_context

A = 5


def relation_of(artifact, classes):
    return Posterior(artifact, scene_of(classes)).relation_log_odds()[:, :2, :2]


def test_without_context_the_other_objects_change_no_relation():
    artifact = larger_artifact("triway-states")
    alone, together = (relation_of(artifact, classes) for classes in ([0, 1], [0, 1, 4, 5]))
    assert np.abs(alone - together).max() > 0.01
    variant = without_context(artifact)
    alone, together = (relation_of(variant, classes) for classes in ([0, 1], [0, 1, 4, 5]))
    np.testing.assert_allclose(alone, together, atol=1e-5)


@pytest.mark.parametrize("left_out", [{"relation": 0.0}, {"counts": 0.0}])
def test_a_score_at_a_place_is_left_out(left_out):
    fit = PlaceFit(relation=0.7, counts=0.4, intercept=-1.0)
    artifact = larger_artifact("triway-states", at=(fit,) * A)
    expected = larger_artifact("triway-states", at=(fit.model_copy(update=left_out),) * A)
    question = scene_of([0, 2]), "on-top", 1
    found = missing_log_p_at(at_a_place(**left_out)(artifact), *question)
    np.testing.assert_array_equal(found, missing_log_p_at(expected, *question))
    proposed = np.isfinite(found)
    assert np.abs(found[proposed] - missing_log_p_at(artifact, *question)[proposed]).max() > 1e-4


def test_every_variant_keeps_the_other_scores():
    artifact = larger_artifact("triway-states", missing=CountSlope(slope=0.5))
    for variants in VARIANTS.values():
        for change in variants.values():
            assert change(artifact).calibration.missing == artifact.calibration.missing


def test_kinds_that_the_model_does_not_judge_stay_unjudged():
    artifact = larger_artifact("triway-states")
    judged = misplaced(relation=0.0)(artifact).calibration.misplaced
    assert judged.confirmed == artifact.calibration.misplaced.confirmed
    for kind in KINDS:
        before, after = (getattr(one, kind) for one in (artifact.calibration.misplaced, judged))
        assert (after is None) == (before is None)
        assert after is None or after.relation == 0.0
