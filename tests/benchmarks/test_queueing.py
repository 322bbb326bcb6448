"""The queueing model, against closed forms and a simulation."""

from __future__ import annotations

import pytest

from benchmarks.queueing import erlang_c, mean_wait, replicas_for


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
