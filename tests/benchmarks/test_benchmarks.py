"""Every benchmark at a tiny size: complete results, finite ratios, yardsticks doing the same work.
No test here looks at speed: that is what the benchmarks are for."""

import io
import math

import httpx
import pytest
from rich.console import Console

from benchmarks.load import plain
from benchmarks.load.questions import KINDS, bodies
from benchmarks.queueing import erlang_c, mean_wait, replicas_for
from benchmarks.report import Result


def check_complete(result: Result, rounds: int) -> None:
    """Every contender in every round, and all of it printable."""
    seconds = result.timings.seconds
    assert result.subject in seconds
    assert set(result.targets) <= set(seconds) - {result.subject}
    for values in seconds.values():
        assert len(values) == rounds
        assert all(0 < value < math.inf for value in values)
    console = Console(width=200, file=io.StringIO())
    with console.capture() as capture:
        console.print(result.table())
    text = capture.get()
    assert all(name in text for name in [*seconds, *result.facts])


# `rbms` compiles with torch.jit as it is imported, which torch calls deprecated.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_gibbs_yardsticks_sample_the_same_machine():
    """Means over 4,000 chains within more than 6 standard errors: chance fails below 1e-8."""
    # Imported here, because every worker imports every module of tests, and this takes seconds.
    from benchmarks.gibbs import gibbs

    result = gibbs(V=20, H=10, chains=4000, objects=4, rounds=4)
    check_complete(result, 4)
    ours, sklearn, other = result.facts.values()
    # The variance of 20 bits is at most 5; ten leaves room for what the context ties together.
    error = 6 * math.sqrt(10 / 4000)
    assert ours == pytest.approx(sklearn, abs=error)
    assert ours == pytest.approx(other, abs=error)
    assert ours == pytest.approx(4, abs=1)


def test_log_odds_agree_with_those_of_the_yardstick():
    from benchmarks.log_odds import log_odds

    result = log_odds(V=30, H=12, objects=5, rounds=2)
    check_complete(result, 2)
    assert result.facts["largest difference from scikit-learn"] < 1e-4


LABELS = [f"thing {number}" for number in range(40)]


@pytest.mark.parametrize("kind", KINDS)
async def test_the_yardstick_validates_and_sends_the_prepared_answer(kind: str) -> None:
    transport = httpx.ASGITransport(plain.app)
    async with httpx.AsyncClient(transport=transport, base_url="http://plain") as client:
        scene = bodies(kind, LABELS)[0]
        for question in ("missing", "relations", "outliers", "rooms"):
            answer = f'{{"{question}":[]}}'.encode()
            await client.put(f"/answers/{question}", content=answer)
            found = await client.post(f"/{question}", json=scene)
            assert (found.status_code, found.content) == (200, answer)
            refused = await client.post(f"/{question}", json={"objects": 1})
            assert refused.status_code == 422


def test_one_and_two_servers_are_the_textbook_formulas() -> None:
    for load in (0.1, 0.5, 0.9):
        assert erlang_c(1, load) == pytest.approx(load)
        assert mean_wait(load, 1.0, 1) == pytest.approx(load / (1 - load))
    assert erlang_c(2, 1.0) == pytest.approx(1 / 3)
    assert erlang_c(2, 1.5) == pytest.approx(9 / 14)


def test_many_servers_are_sized() -> None:
    replicas = replicas_for(100_000, 1e-3, 1e-3, share=0.8)
    assert replicas == 125
    assert mean_wait(100_000, 1e-3, replicas) < 1e-6
    assert replicas_for(900, 1e-3, 3e-4) == 2
    with pytest.raises(ValueError, match="servers"):
        erlang_c(2, 2.0)
