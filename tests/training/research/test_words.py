import numpy as np
import pytest

from app.model.word_weights import RowMap
from app.scene import ObjectClass, Vocabulary
from tests.questions.artifacts import LABELS, larger_artifact
from training.fit.configuration import ConfigError
from training.research import words as words_command

SHOWN = ((0, 1), (0, 2, 3), (4,), (1, 5), (0, 6), (2, 4, 7))
HIDDEN = ((2, 3), (4,), (0, 5), (0, 2), (4, 7), (1,))


@pytest.fixture
def lists() -> words_command.Lists:
    masks = np.zeros((2, len(SHOWN), len(LABELS)), np.bool_)
    for mask, parts in zip(masks, (HIDDEN, SHOWN), strict=True):
        for row, classes in enumerate(parts):
            mask[row, list(classes)] = True
    return words_command.Lists([np.array(one) for one in SHOWN], *masks)


def test_auc_and_mrr_count_pairs_and_ranks(lists: words_command.Lists) -> None:
    scores = np.random.default_rng(0).normal(size=(len(SHOWN), len(LABELS))).round(1)
    (auc,) = lists.auc(scores[:, 4:5], np.array([4]))
    hides = [row for row, classes in enumerate(HIDDEN) if 4 in classes]
    others = [row for row in range(6) if row not in hides and 4 not in SHOWN[row]]
    pairs = [(scores[a, 4], scores[b, 4]) for a in hides for b in others]
    assert auc == pytest.approx(np.mean([(a > b) + (a == b) / 2 for a, b in pairs]))
    ranks = []
    for row in (0, 3):
        rivals = [k for k in range(8) if k not in (*HIDDEN[row], *SHOWN[row])]
        ranks += [
            1 / (1 + sum(scores[row, k] > scores[row, t] for k in rivals)) for t in HIDDEN[row]
        ]
    rows, things = np.array([0, 3]), np.arange(8)
    assert lists.mrr(scores[rows][:, :8], rows, things) == pytest.approx(np.mean(ranks))
    assert np.isnan(lists.mrr(scores[:0], rows[:0], things))


def test_left_out_classes_are_read_as_words(lists: words_command.Lists) -> None:
    """Whether the model knows them or not, the map never sees their rows."""
    artifact, left_out = larger_artifact("triway"), np.array([4, 0])
    vectors = words_command.vectors_of(artifact.vocabulary, left_out, aliases=False)
    auc, mrr = words_command.measure(artifact, artifact, lists, left_out, vectors)
    assert {*auc} == {*words_command.METHODS}
    assert {*mrr} == {*words_command.EVIDENCE}
    words = [artifact.vocabulary.meaning("sofa"), artifact.vocabulary.meaning("bed")]
    row_map = RowMap.fit(artifact.weights, artifact.vocabulary, left_out)
    larger = row_map.with_words(artifact.weights, words)
    expected = lists.auc(words_command.log_odds(larger, lists.listed, np.array([9, 10])), left_out)
    assert auc["predicted"] == pytest.approx(expected.tolist())
    trained = lists.auc(words_command.log_odds(artifact.weights, lists.listed, left_out), left_out)
    assert auc["trained"] == pytest.approx(trained.tolist())
    assert f"{np.mean(auc['predicted']):.3f}" in "\n".join(words_command.summary("AUC", auc))


def test_a_table_of_parts_names_classes_of_the_model(tmp_path) -> None:
    path = tmp_path / "parts.csv"
    path.write_text("part,label\n1,sofa\n2,bed\n1,lamp\n", encoding="utf-8")
    vocabulary = Vocabulary([ObjectClass(label) for label in LABELS])
    assert [part.tolist() for part in words_command.read_parts(path, vocabulary)] == [[4, 1], [0]]
    path.write_text("part,label\n1,submarine\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="no class 'submarine'"):
        words_command.read_parts(path, vocabulary)
