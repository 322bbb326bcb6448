"""After its start the service compiles nothing more for any question."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

# A process of its own: in this one other tests have called the loops with arrays of other layouts.
_PROGRAM = """
import sys
from dataclasses import replace
from pathlib import Path

from numba.core.registry import CPUDispatcher

from app import questions
from app.questions.contexts import contexts
from app.registry import Store, load_model_set
from app.scene import Scene, SceneObject
from app.scene.observe import observe
from app.serving.warm_up import warm_up


def compiled():
    return {
        (name, loop): len(value.signatures)
        for name, module in list(sys.modules.items()) if name.startswith("app.")
        for loop, value in vars(module).items() if isinstance(value, CPUDispatcher)
    }


models = load_model_set(Store(Path(sys.argv[1])))
artifact = models.resolve(sys.argv[2])
warm_up(artifact)
before = compiled()
assert sum(before.values()) > 20

labels = artifact.vocabulary.labels
for size in (1, 2, 3, 12):
    things = tuple(
        SceneObject(
            str(k), labels[k], k, confidence=0.9, position=(1.0, 0.4 * k, 0.2 * (k % 3)),
            size=(0.3, 0.3, 0.2),
        )
        for k in range(size)
    )
    bare = Scene(things, room_type=0 if artifact.spec.C else None)
    stated = tuple((k % artifact.spec.A, k + 1, k) for k in range(size - 1))
    scenes = [bare, observe(bare, typical_sizes=artifact.vocabulary.sizes)]
    scenes += [
        replace(bare, relations=stated[:count], relations_complete=complete)
        for count in {1, len(stated)} if stated for complete in (False, True)
    ]
    for scene in scenes:
        questions.relations(artifact, scene, top_k=50, include_opposites=True)
        questions.relations(artifact, scene, pairs=[(0, size - 1)] if size > 1 else None)
        questions.missing(artifact, scene, coverage=1.0, candidates=[40, 41])
        questions.missing(artifact, scene, at=("right", 0), coverage=0.3)
        questions.outliers(artifact, scene)
        questions.outliers(artifact, scene, sensitivity="high", threshold=0.0)
        questions.generate(artifact, scene, count=2, seed=1, steps=2, temperature=1.3)
contexts(artifact)
print([loop for loop, count in compiled().items() if count > before.get(loop, 0)])
"""


@pytest.mark.parametrize("model", ["indoor-triway", "indoor-triway-deep", "indoor-gbm"])
def test_no_question_compiles_a_loop(model: str) -> None:
    """A drawing with two relations once took ten seconds: their arrays had another layout."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(REPOSITORY / "model_store"), model],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr
