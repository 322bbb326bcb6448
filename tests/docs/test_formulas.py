r"""The formulas of docs/models.md, read as they are written: loops over states of tiny machines.

Each function below is the formula in its decorator, term by term, against the code or against the
enumerated joint. The page must hold the formula in these very words, and no other: whoever changes
one changes both. That the code agrees with the joint everywhere is tested in tests/enumeration and
tests/questions, which the page names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
import pytest
import torch

from app.inference.elementary import sigmoid
from app.inference.posterior import ClosedForm, ScenePosterior
from app.questions.calibration import (
    exclusive,
    false_log_odds,
    intruder_line,
    placed_logits,
    relation_probability,
)
from app.questions.counts import distribution
from app.registry import Calibration
from app.registry.description import CountSlope, Slope
from tests.conftest import REPOSITORY
from tests.enumeration.implied import features_by_hand
from tests.enumeration.small_machines import (
    ONE_LAYER,
    SEED_FORM,
    SMALL,
    Joint,
    enumerate_joint,
    same,
    small_machine,
)
from tests.enumeration.test_completions import exactly, machine_of
from tests.questions.log_score import log_score
from tests.questions.test_counts import CHAIR, COUNTS, DESK, LAMP, V, by_hand
from tests.training.test_objectives import toy_batch, toy_machine
from training.config import ObjectiveConfig
from training.machines import BoltzmannMachine, MachineSpec, build
from training.machines.arrays import weights_of
from training.machines.draws import draw_hidden
from training.machines.log_odds import object_log_odds
from training.machines.mean_field import Evidence, mean_field
from training.machines.partition import ais, base_log_partition, independent_base
from training.objectives import OBJECTIVES
from training.objectives.composite import mask_one_class
from training.objectives.contrastive import relation_nll

LOCAL = [name for name in SMALL if name not in SEED_FORM]
TRIWAYS = [name for name, spec in SMALL.items() if spec.variant == "triway"]
LOCAL_TRIWAYS = [n for n in TRIWAYS if n in LOCAL and n in ONE_LAYER and not SMALL[n].G]
STATES = 12

FORMULAS: dict[str, Callable[[], None]] = {}


def formula(text: str) -> Callable[[Callable[[], None]], Callable[[], None]]:
    """Register the reading of a formula."""

    def register(reading: Callable[[], None]) -> Callable[[], None]:
        FORMULAS[text] = reading
        return reading

    return register


def sigma(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def zeta(x: float) -> float:
    return math.log1p(math.exp(x))


def near(value: object) -> object:
    return pytest.approx(value, rel=1e-9, abs=1e-9)


class Weights:
    """A machine's parameters by the letters of the page, and its relation units."""

    def __init__(self, machine: BoltzmannMachine, edges: object) -> None:
        self.machine, self.spec = machine, machine.spec
        for name, value in machine.named_parameters():
            setattr(self, name, value.detach().numpy())
        ends = (edges.relation[0], edges.subject[0], edges.object[0])
        self.units = list(zip(*(end.tolist() for end in ends), strict=True))
        self.table = [tuple(row) for row in machine.triples.tolist()]

    def row(self, e: tuple[int, int, int]) -> np.ndarray:
        if self.spec.variant in ("rbm", "gbm"):
            return self.U[self.table.index(e)]
        a, i, j = e
        shared = sum(self.S[i, k] * self.O[j, k] * self.M[a, k] for k in range(self.spec.K))
        return self.P[a] + shared

    def gate(self, e: tuple[int, int, int], v: np.ndarray) -> float:
        return v[e[1]] * v[e[2]] if self.spec.variant == "triway" else 1.0

    def logit(self, e: tuple[int, int, int], v: np.ndarray, h1: np.ndarray) -> float:
        a, i, j = e
        if self.spec.variant != "triway":
            t = self.table.index(e)
            ends = self.g[t, 0] * v[i] + self.g[t, 1] * v[j] if self.spec.variant == "gbm" else 0.0
            return self.d[t] + ends + self.row(e) @ h1
        factors = sum(self.S[i, k] * self.R[a, k] * self.O[j, k] for k in range(self.spec.K))
        own = self.residual[self.table.index(e)] if e in self.table else 0.0
        return self.d[a] + self.s[a, i] + self.o[a, j] + factors + own + self.row(e) @ h1


def states(names: list[str]) -> Iterator[tuple[Weights, Joint, int]]:
    """Some states of each machine: its weights, its joint and the state's number."""
    for name in names:
        machine = small_machine(name)
        if SMALL[name].variant == "triway":
            machine.get_parameter("kappa").zero_()  # the page's energy has no offset
        joint = enumerate_joint(machine)
        weights = Weights(machine, joint.edges)
        generator = torch.Generator().manual_seed(5)
        for n in torch.randint(len(joint.v), (STATES,), generator=generator).tolist():
            yield weights, joint, n


def at(joint: Joint, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return tuple(block[n].numpy() for block in (joint.v, joint.r, joint.h1, joint.h2))


def rho(w: Weights, e: tuple[int, int, int], r: float, logit: float) -> float:
    return r * logit - zeta(logit) if w.spec.form == "local" else r * logit


# ------------------------------------------------------------------------------------ the energy


@formula(
    r"E(v, r, h_1, h_2) = -b \cdot v - c_1 \cdot h_1 - c_2 \cdot h_2 - v^\top W h_1"
    r" - h_1^\top J h_2 - \sum_e g_e \, \rho_e"
)
def energy() -> None:
    for w, joint, n in states(list(SMALL)):
        v, r, h1, h2 = at(joint, n)
        E = -w.b @ v - w.c1 @ h1 - w.c2 @ h2 - v @ w.W @ h1 - h1 @ w.J @ h2
        for e, on in zip(w.units, r, strict=True):
            E -= w.gate(e, v) * rho(w, e, on, w.logit(e, v, h1))
        assert float(joint.energy[n]) == near(E)


@formula(r"\rho_e = r_e \, \ell_e - \zeta(\ell_e)")
def local_form() -> None:
    for w, joint, n in states(LOCAL):
        gate = w.machine.gate(joint.edges, joint.v[n : n + 1])
        logits = w.machine.relation_logits(joint.edges, joint.v[n : n + 1], joint.h1[n : n + 1])
        term = w.machine.relation_term(logits, gate, joint.r[n : n + 1], gate >= 0)
        for k in range(len(w.units)):
            r, ell = float(joint.r[n, k]), float(logits[0, k])
            assert float(term[0, k]) == near(float(gate[0, k]) * (r * ell - zeta(ell)))


def check_logits(variant: str) -> None:
    for w, joint, n in states([name for name, spec in SMALL.items() if spec.variant == variant]):
        v, _, h1, _ = at(joint, n)
        logits = w.machine.relation_logits(joint.edges, joint.v[n : n + 1], joint.h1[n : n + 1])
        for k, e in enumerate(w.units):
            assert float(logits[0, k]) == near(w.logit(e, v, h1))


@formula(r"\ell_e(h_1) = d_e + U_e \cdot h_1")
def logits_of_the_rbm() -> None:
    check_logits("rbm")


@formula(r"\ell_e(v, h_1) = d_e + g_{e1} v_i + g_{e2} v_j + U_e \cdot h_1")
def logits_of_the_gbm() -> None:
    check_logits("gbm")


@formula(
    r"\ell_e(h_1) = d_a + s_{ai} + o_{aj} + \sum_k S_{ik} R_{ak} O_{jk} + w'_e"
    r" + n_{a1} \log n_i + n_{a2} \log n_j + U_e \cdot h_1"
)
def logits_of_the_triway() -> None:
    check_logits("triway")
    machine = small_machine("triway-local")
    counts = torch.tensor([[3.0, 2.0]]).double()
    edges = machine.edges(torch.arange(2).unsqueeze(0), counts)
    w, v, h1 = Weights(machine, edges), np.ones(2), np.ones(2)
    found = machine.relation_logits(edges, torch.ones(1, 2).double(), torch.ones(1, 2).double())
    for k, (a, i, j) in enumerate(w.units):
        many = w.n[a, 0] * math.log(counts[0, i]) + w.n[a, 1] * math.log(counts[0, j])
        assert float(found[0, k]) == near(w.logit((a, i, j), v, h1) + many)


@formula(r"g_e = v_i \, v_j")
def gate() -> None:
    for w, joint, n in states(TRIWAYS):
        found = w.machine.gate(joint.edges, joint.v[n : n + 1])[0]
        assert found.tolist() == [joint.v[n, i] * joint.v[n, j] for _, i, j in w.units]


@formula(r"U_e = P_a + \sum_k S_{ik} O_{jk} M_{ak}")
def shared_weights() -> None:
    for w, joint, _ in states(TRIWAYS):
        rows = w.machine.relation_context(joint.edges)[0]
        for k, e in enumerate(w.units):
            assert rows[k].numpy() == near(w.row(e))


# ---------------------------------------------------------------------------------- conditionals


def log_odds_given_others(joint: Joint, block: torch.Tensor, k: int, n: int) -> float:
    """Of unit k of one block, all other units as in state n."""
    given = torch.ones(len(joint.v), dtype=torch.bool)
    for other in (joint.v, joint.r, joint.h1, joint.h2):
        kept = torch.arange(other.shape[1]) != (k if other is block else -1)
        given &= same(other[:, kept], other[n, kept])
    return joint.log_odds(block[:, k] > 0, given)


@formula(r"p(r_e = 1 \mid v, h_1) = g_e \, \sigma(\ell_e)")
def relations_given_the_context() -> None:
    for w, joint, n in states(["rbm", "gbm", "triway-seed", "triway-local-two-layers"]):
        v, _, h1, _ = at(joint, n)
        for k, e in enumerate(w.units):
            if w.gate(e, v):
                exact = sigma(log_odds_given_others(joint, joint.r, k, n))
                assert exact == near(w.gate(e, v) * sigma(w.logit(e, v, h1)))


@formula(
    r"p(h_{1k} = 1 \mid v, r, h_2) = \sigma\Bigl(c_{1k} + \sum_i v_i W_{ik} + \sum_e r_e U_{ek}"
    r" + \sum_l J_{kl} h_{2l}\Bigr)"
)
def context_given_the_rest() -> None:
    for w, joint, n in states(["rbm", "gbm", "triway-seed", "triway-seed-two-layers"]):
        v, r, _, h2 = at(joint, n)
        for k in range(w.spec.H1):
            related = sum(on * w.row(e)[k] for e, on in zip(w.units, r, strict=True))
            x = w.c1[k] + v @ w.W[:, k] + related + w.J[k] @ h2
            assert sigma(log_odds_given_others(joint, joint.h1, k, n)) == near(sigma(x))


@formula(r"p(h_{2l} = 1 \mid h_1) = \sigma\Bigl(c_{2l} + \sum_k h_{1k} J_{kl}\Bigr)")
def second_layer() -> None:
    for w, joint, n in states([name for name in SMALL if name not in ONE_LAYER]):
        h1 = at(joint, n)[2]
        for unit in range(w.spec.H2):
            x = w.c2[unit] + h1 @ w.J[:, unit]
            assert sigma(log_odds_given_others(joint, joint.h2, unit, n)) == near(sigma(x))


@formula(
    r"\log \frac{p(v_i = 1 \mid h_1)}{p(v_i = 0 \mid h_1)} = b_i + W_i \cdot h_1"
    r" + \sum_{e \in R_i} \zeta(\ell_e)"
)
def objects_given_the_context() -> None:
    for w, joint, n in states(["triway-seed", "triway-local"]):
        v, _, h1, _ = at(joint, n)
        for i in range(w.spec.V):
            with_it = v.copy()
            with_it[i] = 1
            pulled = 0.0
            if w.spec.form == "seed":
                touching = [e for e in w.units if i in e[1:] and w.gate(e, with_it)]
                pulled = sum(zeta(w.logit(e, with_it, h1)) for e in touching)
            others = torch.arange(w.spec.V) != i
            given = same(joint.h1, joint.h1[n]) & same(joint.v[:, others], joint.v[n, others])
            exact = joint.log_odds(joint.v[:, i] > 0, given)
            assert exact == near(w.b[i] + w.W[i] @ h1 + pulled)


# ---------------------------------------------------------------------------------- free energies


@formula(
    r"F(v, r) = -b \cdot v - \sum_e r_e \, \ell_e(0)"
    r" - \sum_k \zeta\Bigl(c_{1k} + \sum_i v_i W_{ik} + \sum_e r_e U_{ek}\Bigr)"
)
def free_energy_of_the_seed_form() -> None:
    for w, joint, n in states(["rbm", "rbm-three-classes", "gbm-one-layer", "triway-seed"]):
        v, r, h1, _ = at(joint, n)
        F = -w.b @ v - sum(
            on * w.logit(e, v, 0 * h1) for e, on in zip(w.units, r, strict=True) if on
        )
        for k in range(w.spec.H1):
            related = sum(on * w.row(e)[k] for e, on in zip(w.units, r, strict=True))
            F -= zeta(w.c1[k] + v @ w.W[:, k] + related)
        exact = -joint.log_sum(same(joint.v, joint.v[n]) & same(joint.r, joint.r[n]))
        assert exact == near(F)


@formula(
    r"F(v) = -b \cdot v - \sum_k \zeta\Bigl(c_{1k} + \sum_i v_i W_{ik}\Bigr)",
)
def free_energy_of_the_local_form() -> None:
    for w, joint, n in states([name for name in LOCAL if name in ONE_LAYER]):
        v = at(joint, n)[0]
        F = -w.b @ v - sum(zeta(w.c1[k] + v @ w.W[:, k]) for k in range(w.spec.H1))
        assert -joint.log_sum(same(joint.v, joint.v[n])) == near(F)


# ----------------------------------------------------------------------------------------- scores


@formula(
    r"\lambda_i = b_i + \sum_k \bigl[\zeta(x_k + W_{ik}) - \zeta(x_k)\bigr],"
    r" \quad x = c_1 + \sum_{j \neq i} v_j W_j"
)
def log_odds_of_an_object() -> None:
    for w, joint, n in states([name for name in LOCAL if name in ONE_LAYER]):
        v = at(joint, n)[0]
        for i in range(w.spec.V):
            others = torch.arange(w.spec.V) != i
            x = w.c1 + sum(v[j] * w.W[j] for j in range(w.spec.V) if j != i)
            gain = sum(zeta(x[k] + w.W[i, k]) - zeta(x[k]) for k in range(w.spec.H1))
            given = same(joint.v[:, others], joint.v[n, others])
            assert joint.log_odds(joint.v[:, i] > 0, given) == near(w.b[i] + gain)


@formula(r"\zeta(x + W) - \zeta(x) = \log\bigl(1 + \sigma(x)(e^W - 1)\bigr)")
def one_factor() -> None:
    for x, W in product(np.linspace(-4, 4, 9), repeat=2):
        assert zeta(x + W) - zeta(x) == near(math.log(1 + sigma(x) * (math.exp(W) - 1)))


@formula(
    r"\lambda_i = \log \mathbb{E}_{h_1 \mid \text{rest}}\Bigl[\exp\Bigl(b_i + W_i \cdot h_1"
    r" + \sum_{e \in R_i} \zeta(\ell_e)\Bigr)\Bigr]"
)
def log_odds_as_an_expectation() -> None:
    for w, joint, n in states(["triway-seed", "triway-local"]):
        v, _, _, _ = at(joint, n)
        for i in range(w.spec.V):
            others = torch.arange(w.spec.V) != i
            # The rest: all other objects, and the relations between them.
            kept = torch.tensor([i not in e[1:] for e in w.units])
            given = same(joint.v[:, others], joint.v[n, others])
            given &= same(joint.r[:, kept], joint.r[n, kept])
            absent = given & (joint.v[:, i] == 0)
            weight = (-joint.energy[absent]).softmax(0).numpy()
            with_it = v.copy()
            with_it[i] = 1
            expected = 0.0
            for p, h1 in zip(weight, joint.h1[absent].numpy(), strict=True):
                pulled = 0.0
                if w.spec.form == "seed":
                    touching = [e for e in w.units if i in e[1:] and w.gate(e, with_it)]
                    pulled = sum(zeta(w.logit(e, with_it, h1)) for e in touching)
                expected += p * math.exp(w.b[i] + w.W[i] @ h1 + pulled)
            assert joint.log_odds(joint.v[:, i] > 0, given) == near(math.log(expected))


@formula(r"\log w(h_1) = h_1 \cdot x + \sum_{e} g_e \, \rho_e(h_1) - \log q(h_1)")
def weights_of_draws() -> None:
    for w, joint, n in states(["triway-local"]):
        v, r, _, _ = at(joint, n)
        observed = torch.ones(1, len(w.units), dtype=torch.bool)
        evidence = Evidence(joint.v[n : n + 1], joint.edges, joint.r[n : n + 1], observed)
        drawn = draw_hidden(w.machine, evidence, draws=8)
        y, x = drawn.field.y[0].numpy(), w.c1 + v @ w.W
        log_w = []
        for h1 in drawn.h1[:, 0].numpy():
            log_q = sum(math.log(sigma(y[k]) if h1[k] else 1 - sigma(y[k])) for k in range(len(y)))
            related = sum(
                w.gate(e, v) * rho(w, e, on, w.logit(e, v, h1))
                for e, on in zip(w.units, r, strict=True)
            )
            log_w.append(h1 @ x + related - log_q)
        total = math.log(sum(math.exp(value) for value in log_w))
        assert drawn.log_weight[:, 0].numpy() == near(np.array(log_w) - total)


def mean_of_sigmas(w: Weights, joint: Joint, given: torch.Tensor, k: int) -> float:
    """E[σ(ℓ_e)] over h1 from the joint where `given`."""
    weight = (-joint.energy[given]).softmax(0).numpy()
    blocks = zip(weight, joint.v[given].numpy(), joint.h1[given].numpy(), strict=True)
    return float(sum(p * sigma(w.logit(w.units[k], v, h1)) for p, v, h1 in blocks))


@formula(
    r"p(r_e = 1 \mid \text{rest}) ="
    r" \mathbb{E}_{h_1 \mid \text{rest}}\bigl[\sigma(\ell_e(h_1))\bigr]"
)
def relation_as_an_expectation() -> None:
    for w, joint, n in states(["triway-local"]):
        v = at(joint, n)[0]
        for k, e in enumerate(w.units):
            # Of the other relations every second one is given.
            kept = torch.tensor([other != k and other % 2 == 0 for other in range(len(w.units))])
            given = same(joint.v, joint.v[n]) & same(joint.r[:, kept], joint.r[n, kept])
            if w.gate(e, v):
                exact = sigma(joint.log_odds(joint.r[:, k] > 0, given))
                assert exact == near(mean_of_sigmas(w, joint, given, k))


@formula(
    r"m_1 = \sigma\Bigl(c_1 + v^\top W + J m_2 + \sum_e \frac{\partial \rho_e}{\partial \ell_e}"
    r" U_e\Bigr), \quad m_2 = \sigma(c_2 + m_1^\top J)"
)
def fixed_point() -> None:
    for w, joint, n in states(["gbm", "triway-seed-two-layers", "triway-local-two-layers"]):
        v, r, _, _ = at(joint, n)
        observed = torch.ones(1, len(w.units), dtype=torch.bool)
        evidence = Evidence(joint.v[n : n + 1], joint.edges, joint.r[n : n + 1], observed)
        field = mean_field(w.machine, evidence, iterations=150)
        m1, m2 = field.y[0].sigmoid().numpy(), field.h2[0].numpy()
        x = w.c1 + v @ w.W + w.J @ m2
        for e, on in zip(w.units, r, strict=True):
            slope = on - sigma(w.logit(e, v, m1)) if w.spec.form == "local" else on
            x = x + w.gate(e, v) * slope * w.row(e)
        assert m1 == pytest.approx([sigma(value) for value in x], abs=1e-6)
        assert m2 == pytest.approx([sigma(value) for value in w.c2 + m1 @ w.J], abs=1e-6)


def wide_machine() -> BoltzmannMachine:
    """A local Triway with as many hidden units as the closed form asks for."""
    spec = MachineSpec("triway", V=4, A=2, H1=200, K=3, form="local")
    machine = build(spec).initialise(torch.Generator().manual_seed(2), scale=0.3)
    return machine.requires_grad_(False)


@formula(
    r"\ell_e \sim \mathcal{N}\Bigl(\ell_e(m), \sum_k U_{ek}^2 \, m_k (1 - m_k)\Bigr)",
)
def normal_logits() -> None:
    machine = wide_machine()
    closed = ClosedForm(weights_of(machine))
    classes = np.arange(3)
    context = closed.context(classes, np.ones(3, np.float32), np.zeros(3, np.float32))
    found = ScenePosterior(closed, context).relation_log_odds()
    w = Weights(machine, machine.edges(torch.arange(4).unsqueeze(0)))
    v = np.array([1.0, 1.0, 1.0, 0.0])
    m = np.array([sigma(x) for x in w.c1 + v @ w.W])
    nodes, mass = np.polynomial.hermite_e.hermegauss(60)
    for a, i, j in product(range(2), range(3), range(3)):
        spread = math.sqrt(sum(w.row((a, i, j)) ** 2 * m * (1 - m)))
        mean = w.logit((a, i, j), v, m)
        p = sum(q * sigma(mean + spread * z) for z, q in zip(nodes, mass, strict=True)) / sum(mass)
        assert sigma(float(found[a, i, j])) == pytest.approx(p, abs=2e-3)


@formula(
    r"x_e = \sum_f \Bigl(\gamma_{0af} + \sum_q z_q \gamma_{qaf}\Bigr) \, \phi_f(i, j)",
)
def implications() -> None:
    machine = small_machine("triway-implications")
    edges = machine.edges(torch.arange(3).unsqueeze(0))
    w = Weights(machine, edges)
    generator = torch.Generator().manual_seed(3)
    for _ in range(STATES):
        given = torch.randint(2, (1, len(w.units)), generator=generator).double()
        m1 = torch.rand(1, 2, generator=generator).double()
        found = machine.implied(edges, given, m1)[0]
        phi = features_by_hand(edges.unflatten(given)[0]).numpy()
        z = w.B @ m1[0].numpy()
        for k, (a, i, j) in enumerate(w.units):
            x = 0.0
            for f in range(len(phi)):
                if f != a:  # r_e itself
                    strict = sum(z[q] * w.gamma[1 + q, a, f] for q in range(w.spec.G))
                    x += (w.gamma[0, a, f] + strict) * phi[f, i, j]
            assert float(found[k]) == near(x)


# ---------------------------------------------------------------------------------- the questions


def calibration() -> Calibration:
    entry = {"intercept": -0.4, "slope": 0.7, "log_count": 0.3}
    return Calibration.neutral(2).model_copy(update={"missing": CountSlope(**entry)})


@formula(r"x = \alpha_a + \beta_a \lambda_e + \gamma_a \log(n_i n_j) + \delta_a \log n")
@formula(r"p = \sigma\big(x + \sum_k c_k \max(0, x - x_k)\big)")
def calibrated_relations() -> None:
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(2, 8))
    log_odds = rng.normal(size=(1, 2, 3, 3)).astype(np.float32)
    counts = np.array([1, 2, 5])
    logs = np.log(np.outer(counts, counts)).astype(np.float32)
    found = relation_probability(slopes, log_odds.reshape(1, 2, 9), logs.reshape(9), 3)
    found = found.reshape(1, 2, 3, 3)
    for a, i, j in product(range(2), range(3), range(3)):
        alpha, beta, gamma, delta, *bends = slopes[a]
        x = alpha + beta * log_odds[0, a, i, j]
        x += gamma * math.log(counts[i] * counts[j]) + delta * math.log(3)
        bent = x + sum(c * max(0, x - at) for at, c in zip(bends[::2], bends[1::2], strict=True))
        assert found[0, a, i, j] == pytest.approx(sigma(bent), abs=1e-5)


@formula(r"p' = \frac{p}{\max(1, p + q)}")
def exclusion() -> None:
    for p, q in product(np.linspace(0, 1, 11), repeat=2):
        scaled, _ = exclusive(p, q)
        assert scaled == near(p / max(1, p + q))


@formula(r"p(v_i = 1 \mid L) \propto \sum_{v \supseteq L, h} p(v, h) (1 - c)^{|v \setminus L|}")
def unlisted_objects() -> None:
    """The machine with the biases of unlisted classes lowered, whose posterior is estimated."""
    machine, c, listed = machine_of(1), 0.6, [2, 5]
    truth = exactly(machine, listed, c)
    lowered = np.delete(np.arange(len(truth)), listed)
    machine.b[lowered] += math.log(1 - c)
    assert exactly(machine, listed, 0.0) == pytest.approx(truth, abs=1e-6)


@formula(r"p_i = \sigma(\alpha + \beta \lambda_i + \gamma \log n)")
def missing_objects() -> None:
    found, odds = calibration(), np.array([0.3, -1.2, 2.0, 0.1])
    entry = found.missing
    logits = found.missing.log_odds(odds, 7)
    p = sigmoid(logits)
    constant = entry.intercept + entry.log_count * math.log(7)
    assert p == near([sigma(constant + entry.slope * z) for z in odds])


@formula(r"p'_i = p_i \, p(r_e = 1 \mid v_i = 1, \text{rest})")
def missing_at_a_place() -> None:
    found = calibration()
    odds, log_p = np.array([0.3, -1.2]), np.array([-0.5, -2.0])
    there = [sigma(x) for x in found.missing.log_odds(odds, 7)]
    p = [sigma(x) for x in placed_logits(found, odds, log_p, 7)]
    assert p == near([a * math.exp(b) for a, b in zip(there, log_p, strict=True)])


@formula(
    r"p(r_e = 1 \mid v_i = 1, \text{rest}) ="
    r" \mathbb{E}_{h_1 \mid v_i = 1, \text{rest}}\bigl[\sigma(\ell_e(h_1))\bigr]"
)
def placements() -> None:
    for w, joint, n in states(LOCAL_TRIWAYS):
        for k, (_, i, j) in enumerate(w.units):
            v = joint.v[n].clone()
            v[i] = v[j] = 1
            given = same(joint.v, v)
            exact = sigma(joint.log_odds(joint.r[:, k] > 0, given))
            assert exact == near(mean_of_sigmas(w, joint, given, k))


@formula(
    r"p(n) \propto s(n) \, \exp\Bigl(\eta \log n + \zeta \log n \log \frac{M}{n}\Bigr) \,"
    r" \rho^{n - k}, \quad"
    "\n"
    r"\eta = a + b \, [k = 1] + c u + d_t + \frac{1}{\sqrt{m}} \sum_j e_j"
)
def numbers_of_instances() -> None:
    listed = {DESK: 2, CHAIR: 1, LAMP: 1}
    order = np.array(sorted(listed))
    which, p = distribution(COUNTS, V, order, np.array([listed[j] for j in order]), 1, 0.4)
    for row, (at, found) in enumerate(zip(which, p, strict=True)):
        assert COUNTS.classes[row] == order[at]
        assert found == pytest.approx(by_hand(COUNTS, row, listed, 1, 0.4), abs=1e-6)


@formula(r"p(\text{intruder}) = \sigma(\alpha + \beta \lambda_i + \gamma \log n)")
def intruders() -> None:
    entry = CountSlope(intercept=-0.4, slope=-0.7, log_count=0.3)
    intercept, slope = intruder_line(entry, 7)
    assert intercept == near(entry.intercept + entry.log_count * math.log(7))
    assert slope == near(entry.slope)


@formula(r"p(\text{false}) = \sigma(\alpha + \beta \lambda_e)")
def false_relations() -> None:
    odds = np.array([-1.0, 0.5])
    entry = Slope(intercept=-0.4, slope=-0.7)
    assert false_log_odds(entry, odds) == near([entry.intercept + entry.slope * x for x in odds])


@formula(r"\text{score} = -F(v) + \log p(r \mid v, h_1)")
def scores_of_scenes() -> None:
    for w, joint, n in states(LOCAL_TRIWAYS):
        v, r, h1, _ = at(joint, n)
        one = slice(n, n + 1)
        found = log_score(w.machine, joint.v[one], joint.r[one], joint.edges, joint.h1[one], None)
        F = -joint.log_sum(same(joint.v, joint.v[n]))
        log_p = 0.0
        for e, on in zip(w.units, r, strict=True):
            if w.gate(e, v):
                p = sigma(w.logit(e, v, h1))
                log_p += math.log(p if on else 1 - p)
        assert float(found) == near(-F + log_p)


# ------------------------------------------------------------------------ log Z and the objectives


@formula(
    r"\log w = \log Z_0"
    r" + \sum_{t=1}^{T} \bigl[F_{\beta_{t-1}}(s_{t-1}) - F_{\beta_t}(s_{t-1})\bigr]"
)
def annealing() -> None:
    """With T = 1 the first states are exact samples of the base: log w is known for each."""
    machine = small_machine("rbm-local")
    base = independent_base(machine)
    chains = 4000
    found = ais(machine, [0.0, 1.0], chains, torch.Generator().manual_seed(0))
    start = enumerate_joint(machine.scaled(0.0, base))
    cold = enumerate_joint(machine)
    log_z0 = base_log_partition(machine, base)
    assert start.log_z == near(log_z0)
    expected = 0.0
    for v in torch.cartesian_prod(*[torch.tensor([0.0, 1.0]).double()] * 2):
        rows = same(start.v, v)
        p = float(start.p[rows].sum())
        before, after = -start.log_sum(rows), -cold.log_sum(same(cold.v, v))
        expected += p * (log_z0 + before - after)
    assert found.bound == pytest.approx(expected, abs=5 * found.standard_error + 0.02)


@formula(
    r"-\nabla \log p(\text{data}) = \langle \nabla E \rangle_{\text{data}}"
    r" - \langle \nabla E \rangle_{\text{model}}"
)
def gradient_of_the_likelihood() -> None:
    machine = small_machine("triway-local").requires_grad_(True)
    machine.kappa.requires_grad_(False)
    joint = enumerate_joint(machine)
    given = same(joint.v, torch.ones(2).double())
    energy = machine.energy(joint.v, joint.r, joint.h1, joint.h2, joint.edges)
    named = {n: p for n, p in machine.named_parameters() if p.requires_grad and p.numel()}

    def gradient(value: torch.Tensor) -> dict[str, torch.Tensor]:
        found = torch.autograd.grad(
            value, list(named.values()), retain_graph=True, allow_unused=True
        )
        return dict(zip(named, found, strict=True))

    left = gradient((-energy).logsumexp(0) - (-energy[given]).logsumexp(0))
    data = ((-energy[given]).softmax(0).detach() * energy[given]).sum()
    model = ((-energy).softmax(0).detach() * energy).sum()
    for name, value in gradient(data - model).items():
        if value is not None:
            assert value.numpy() == near(left[name].numpy()), name


@formula(
    r"L = -\log \frac{e^{\lambda_i}}{\sum_{j \text{ absent}} e^{\lambda_j}} + \pi \Bigl[n \,"
    r" \zeta(-\lambda_i) + \sum_{j \text{ absent}, j \neq i} \zeta(\lambda_j)\Bigr]"
)
def composite_likelihood() -> None:
    pi = 0.7
    config = ObjectiveConfig(
        name="composite",
        presence_weight=pi,
        relation_weight=0.0,
        generative_weight=0.0,
        object_dropout=0.0,
        structure_dropout=0.0,
        room_dropout=0.0,
    )
    machine, batch = toy_machine("triway-local"), toy_batch()
    objective = OBJECTIVES["composite"](config, machine)
    found = objective.loss(machine, batch, torch.Generator().manual_seed(4))
    masked = mask_one_class(
        batch, torch.zeros(machine.spec.V, dtype=torch.bool), torch.Generator().manual_seed(4)
    )
    assert masked is not None
    room = masked.batch.room
    odds = object_log_odds(machine, Evidence(masked.v, room=room)).detach().numpy()
    total = 0.0
    for row, i in enumerate(masked.target.tolist()):
        absent = [j for j in range(machine.spec.V) if masked.absent[row, j]]
        n, values = float(masked.removable[row]), odds[row]
        ranking = -math.log(math.exp(values[i]) / sum(math.exp(values[j]) for j in absent))
        presence = n * zeta(-values[i]) + sum(zeta(values[j]) for j in absent if j != i)
        total += ranking + pi * presence
    assert float(found.detach()) == pytest.approx(total / len(masked.target), rel=1e-4)


@formula(
    r"-\log p(r \mid v) \approx \sum_{e} g_e \bigl[\zeta(\ell_e(m)) - r_e \, \ell_e(m)\bigr]",
)
def likelihood_of_relations() -> None:
    for w, joint, n in states(LOCAL_TRIWAYS):
        v, r, _, _ = at(joint, n)
        m = np.array([sigma(x) for x in w.c1 + v @ w.W])
        one = slice(n, n + 1)
        everything = torch.ones(1, len(w.units), dtype=torch.bool)
        found = relation_nll(
            *(w.machine, joint.edges, joint.v[one], torch.tensor(m)[None], joint.r[one]), everything
        )
        total = 0.0
        for e, on in zip(w.units, r, strict=True):
            ell = w.logit(e, v, m)
            total += w.gate(e, v) * (zeta(ell) - on * ell)
        assert float(found) == near(total)


@formula(
    r"\langle F(v, h_2) \rangle_{\text{data}} - \langle F(v, h_2) \rangle_{\text{chains}}",
)
def persistent_chains() -> None:
    """With exact samples for chains, its gradient is that of the likelihood of objects."""
    machine = small_machine("triway-local-two-layers").requires_grad_(True)
    machine.kappa.requires_grad_(False)
    joint = enumerate_joint(machine)
    given = same(joint.v, torch.ones(2).double())
    energy = machine.energy(joint.v, joint.r, joint.h1, joint.h2, joint.edges)
    F = machine.free_energy(joint.v, h2=joint.h2)
    p_data, p_model = ((-e).softmax(0).detach() for e in (energy[given], energy))
    difference = (p_data * F[given]).sum() - (p_model * F).sum()
    exact = (-energy).logsumexp(0) - (-energy[given]).logsumexp(0)
    for name in ("b", "W", "c1", "c2", "J"):
        parameter = machine.get_parameter(name)
        (ours,) = torch.autograd.grad(difference, parameter, retain_graph=True)
        (truth,) = torch.autograd.grad(exact, parameter, retain_graph=True)
        assert ours.numpy() == near(truth.numpy()), name


# ------------------------------------------------------------------------------------------------


def on_the_page() -> list[str]:
    text = (REPOSITORY / "docs" / "models.md").read_text(encoding="utf-8")
    return re.findall(r"^\$\$\n(.*?)\n\$\$$", text, re.DOTALL | re.MULTILINE)


def test_the_page_and_this_file_hold_the_same_formulas() -> None:
    assert sorted(on_the_page()) == sorted(FORMULAS)


@pytest.mark.parametrize("reading", FORMULAS.values(), ids=lambda reading: reading.__name__)
def test_a_formula_holds_as_it_is_written(reading: Callable[[], None]) -> None:
    reading()
