import numpy as np
import pytest

from training.evaluation.metrics import Figure, Ratio, paired_difference
from training.evaluation.report import SourceReport
from training.evaluation.results import Cell, Difference, Results, summarise
from training.evaluation.setting import Outcome


def figure(value):
    return Figure(value, value, value, 1)


def report(source, **metrics):
    ratios = {name: Ratio.of_scenes(np.array(values)) for name, values in metrics.items()}
    return {source: SourceReport(source, "", {"T2 missing": Outcome(ratios, 3, 0)})}


def test_tables_of_relations_say_that_unlisted_relations_count_as_wrong():
    for task, metric in (("T1b completion", "R-precision"), ("T2 missing", "MRR, one removed")):
        text = Results("a", (Cell("a", task, "x", metric, figure(0.5), (0.5,)),), ()).markdown()
        assert ("An unlisted relation counts as wrong" in text) is task.startswith("T1")


@pytest.mark.parametrize(
    ("metric", "low", "high", "verdict"),
    [
        ("MRR", 0.1, 0.2, "better"),
        ("MRR", -0.1, 0.2, "undecided"),
        ("MRR", -0.2, -0.1, "worse"),
        ("MMD², free", -0.2, -0.1, "better"),
        ("ECE, missing, 2 classes", 0.1, 0.2, "worse"),
        ("change of MRR, poses", 0.1, 0.2, "better"),
        ("mirrored relations, free", -0.2, -0.1, "better"),
        ("on-top cycles, free", 0.1, 0.2, "worse"),
    ],
)
def test_a_verdict_needs_the_whole_interval_on_the_better_side(metric, low, high, verdict):
    figure = Figure((low + high) / 2, low, high, 1)
    assert Difference("a", "T", "x", metric, figure).verdict == verdict


def test_results_list_the_questions():
    metrics = {"MMD²": Ratio(np.array([0.5, 0.5]), np.ones(2))}
    outcome = Outcome(metrics, 7, 2, {"bandwidth": 4.0})
    report = SourceReport("x", "", {"T4 generate": outcome, "Density": None})
    (asked,) = summarise({("a", 0): {"x": report}}, "a").to_dict()["asked"]
    assert asked == {
        "row": "a", "seed": 0, "task": "T4 generate", "source": "x", "scenes": 7, "skipped": 2,
        "notes": {"bandwidth": 4.0},
    }  # fmt: skip


def test_skipped_scenes_are_listed_by_source():
    skipped = (("x", 8), ("x", 9), ("y", 0))
    asked = [{"task": "T2", "source": source, "skipped": count} for source, count in skipped]
    cells = (Cell("a", "T2", "x", "MRR", figure(0.1), (0.1,)),)
    text = Results("a", cells, (), asked=tuple(asked)).markdown({"T2": ("MRR",)})
    assert text.endswith("\n\nScenes that could not be scored: 9 of x.\n")


def test_a_row_is_compared_by_scene_where_the_reference_row_has_the_metric():
    """Differences (.5, .5, -.25) of three scenes; the metric of one row alone is not compared."""
    reports = {
        ("ours", 0): report("x", MRR=[1.0, 0.5, 0.25]),
        ("other", 0): report("x", MRR=[0.5, 0.0, 0.5], extra=[1.0, 1.0, 1.0]),
    }
    results = summarise(reports, "ours")
    assert {(cell.row, cell.metric) for cell in results.cells} == {
        ("ours", "MRR"), ("other", "MRR"), ("other", "extra"),
    }  # fmt: skip
    (gap,) = results.differences
    assert (gap.row, gap.task, gap.source, gap.metric) == ("other", "T2 missing", "x", "MRR")
    assert gap.figure == paired_difference(
        *(reports[row, 0]["x"].outcomes["T2 missing"].metrics["MRR"] for row in ("ours", "other"))
    )
    assert gap.figure.value == pytest.approx(0.25)


def test_a_summary_needs_our_row_and_pairs_equal_scenes():
    """A metric that one row has on two sources, and another row on one of them."""
    with pytest.raises(ValueError, match="no metric of the reference row ours"):
        summarise({}, "ours")
    scenes = {"ours": 4, "other": 2}
    reports = {(name, 0): report("pooled", MRR=[1.0] * n) for name, n in scenes.items()}
    assert summarise(reports, "ours").differences == ()
