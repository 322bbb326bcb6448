"""Words that the default model has no class for, beside boxes and relations."""

import pytest

from scene_client import OfflineClient
from tests.conftest import REPOSITORY

TABLE = {"id": "t", "label": "table", "position": [1, 0, 0.37], "size": [1, 1, 0.75]}
WORD = {"id": "h", "label": "hovercraft", "position": [1, 0, 0.8], "size": [0.1, 0.1, 0.1]}
SCENES = {
    "boxes": {"objects": [TABLE, WORD]},
    "relations": {
        "objects": ["table", "hovercraft", "chopstick rest", "plate"],
        "relations": [["hovercraft", "on-top", "table"]],
    },
}


@pytest.fixture(scope="module")
def client():
    with OfflineClient(str(REPOSITORY / "model_store")) as client:
        yield client


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("question", ["outliers", "missing", "relations", "generate"])
def test_a_word_by_meaning_has_answers(client, question, scene):
    drawn = {"count": 8, "seed": 0} if question == "generate" else {}
    answer = getattr(client, question)(**SCENES[scene], **drawn, unknown_labels="by-meaning")
    assert answer
    if question == "outliers":
        assert {"hovercraft", "h"} & {entry.subject for entry in answer.misplaced}
