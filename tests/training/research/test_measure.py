from types import SimpleNamespace

import pytest

from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.evaluation.setting import Model, Setting
from training.research.measure import POOLED, Entry, Plan, measure_entries


def answers(*_):
    return Model()


def diverges(*_):
    raise FloatingPointError("loss is nan")


def breaks(*_):
    raise RuntimeError("broken")


def plan(folder, material="these scenes"):
    setting = Setting(tensors([scene([0], name="one")]), NO_STRUCTURE)
    settings = {"none": setting, POOLED: setting}
    return Plan(folder, SimpleNamespace(digest=material), settings, ["T2 missing"])


@pytest.mark.slow
def test_an_error_other_than_divergence_stops_all_processes(tmp_path):
    entries = [Entry(name, 0, name, make) for name, make in (("a", breaks), ("b", answers))]
    with pytest.raises(RuntimeError, match="broken"):
        measure_entries(plan(tmp_path), entries, workers=2)


def test_another_row_or_other_scenes_have_other_folders(tmp_path):
    first = plan(tmp_path), Entry("row", 0, "1", answers)
    others = (plan(tmp_path, "other scenes"), first[1]), (first[0], Entry("row", 0, "2", answers))
    for material, entry in (first, *others):
        assert not material.finished(entry)
        measure_entries(material, [entry])
    measure_entries(first[0], [Entry("row", 0, "1", diverges)])
