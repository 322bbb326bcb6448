"""The compiled elementary functions against numpy's in double precision."""

import sys

import numpy as np
import pytest
from numba import njit

from app.inference import elementary
from tests.conftest import run_program


def compiled(name):
    function = getattr(elementary, name)

    @njit
    def apply(x, out):
        for i in range(len(x)):
            out[i] = function(x[i])

    def run(x):
        out = np.empty_like(x)
        apply(x, out)
        return out

    return run


@pytest.mark.parametrize(
    ("name", "bound", "most"),
    [*(("exp", bound, 2) for bound in (1e-3, 1.0, 20.0, 86.9)), ("logistic", 86.0, 4)],
)
def test_error_in_units_in_the_last_place(name, bound, most):
    x = np.linspace(-bound, bound, 200_001, dtype=np.float32)
    exp = np.exp(x.astype(np.float64))
    exact = {"exp": exp, "logistic": exp / (1 + exp)}[name]
    error = np.abs(compiled(name)(x).astype(np.float64) - exact)
    assert (error / np.spacing(exact.astype(np.float32))).max() < most


def test_exp_stays_finite_and_positive():
    x = np.array([-np.inf, -1e30, -88.0, 89.0, 1e30, np.inf], dtype=np.float32)
    found = compiled("exp")(x)
    assert np.isfinite(found).all()
    assert (found > 0).all()
    assert found[0] == found[2] < 1e-37
    assert found[-1] == found[3] > 1e38


def test_log():
    x = np.concatenate(
        [
            np.exp(np.linspace(-86, 88, 200_001)).astype(np.float32),
            np.linspace(0.5, 2.0, 200_001, dtype=np.float32),
        ]
    )
    exact = np.log(x.astype(np.float64))
    error = np.abs(compiled("log")(x) - exact)
    # Near one the value vanishes: there the error is one of the argument.
    assert (error <= 2 * np.spacing(np.abs(exact).astype(np.float32)) + 1e-8).all()
    assert compiled("log")(np.ones(1, np.float32))[0] == 0


_GAINS = """
import sys
import numpy as np
from app.inference.objects import HiddenLogOdds
random = np.random.default_rng(7)
weights, x = random.normal(size=(500, 30)), random.normal(size=(2, 30))
gain = HiddenLogOdds(weights.astype("f4"), 3)(x.astype("f4"))
np.save(sys.argv[1], gain)
"""


@pytest.mark.slow
def test_loops_for_a_generic_processor_give_equal_numbers(tmp_path, monkeypatch):
    """The image is compiled for NUMBA_CPU_NAME=generic."""
    gains = []
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "loops"))
    for cpu in ("own", "generic"):
        if cpu == "generic":
            monkeypatch.setenv("NUMBA_CPU_NAME", cpu)
            monkeypatch.setenv("NUMBA_CPU_FEATURES", "")
        path = tmp_path / f"{cpu}.npy"
        run_program(sys.executable, "-c", _GAINS, path)
        gains.append(np.load(path))
    assert len(list(tmp_path.glob("loops/*/*/objects._hidden_log_odds*.nbc"))) == 2
    np.testing.assert_allclose(*gains, rtol=1e-5, atol=1e-5)
