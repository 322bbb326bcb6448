"""After its start the service compiles nothing more for any question."""

import sys

from tests.conftest import REPOSITORY, run_program

# A process of its own: in this one other tests have called the loops with arrays of other layouts.
_PROGRAM = """
import asyncio
import sys
from pathlib import Path

from numba.core.registry import CPUDispatcher

from app.registry import Store
from tests.services import serve


def compiled():
    return {
        (name, loop): len(value.signatures)
        for name, module in list(sys.modules.items()) if name.startswith("app.")
        for loop, value in vars(module).items() if isinstance(value, CPUDispatcher)
    }


def scenes(labels):
    for size in (1, 2, 3, 12):
        bare = {"objects": [{"label": label, "confidence": 0.9} for label in labels[:size]]}
        poses = [
            {**thing, "position": [1.0, 0.4 * k, 0.2 * (k % 3)], "size": [0.3, 0.3, 0.2]}
            for k, thing in enumerate(bare["objects"])
        ]
        stated = [
            (labels[k + 1], name, labels[k])
            for k, name in zip(range(size - 1), 3 * ("left", "front", "on-top", "above"))
        ]
        yield bare
        yield {"objects": poses}
        for count in {1, len(stated)} if stated else ():
            for complete in (False, True):
                yield {**bare, "relations": stated[:count], "relations_complete": complete}


async def main(store):
    limits = {"request_timeout_ms": 600_000, "max_request_timeout_ms": 600_000}
    async with serve(store, **limits) as client:

        async def ask(question, scene, **options):
            body = {**scene, "model": model, **options}
            response = await client.post(f"/{question}", json=body)
            assert response.status_code == 200, response.text

        before = compiled()
        assert sum(before.values()) > 20
        for model in ("places-triway", "places-rbm"):
            vocabulary = Store(store).load(*Store(store).resolve(model)).model.vocabulary
            labels, rooms = vocabulary.labels, vocabulary.room_types
            for scene in scenes(labels):
                some = {"pairs": [labels[:2]]} if len(scene["objects"]) > 1 else {}
                await ask("relations", scene, top_k=50, include_opposites=True)
                await ask("relations", scene, **some)
                await ask("missing", scene, coverage=1.0, candidates=labels[40:42])
                await ask("missing", scene, at=("right", labels[0]), coverage=0.3)
                await ask("outliers", scene)
                await ask("outliers", scene, sensitivity="high", threshold=0.0)
                await ask("rooms", scene, candidates=rooms[:2])
                await ask("generate", scene, count=2, seed=1, steps=2, temperature=1.3)
        print([loop for loop, count in compiled().items() if count > before.get(loop, 0)])

asyncio.run(main(Path(sys.argv[1])))
"""


def test_no_question_compiles_a_loop() -> None:
    store = REPOSITORY / "model_store"
    assert run_program(sys.executable, "-c", _PROGRAM, store, timeout=600).stdout == "[]\n"
