from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import softplus

from app.inference.weights import unpack_scenes
from tests.enumeration.small_machines import binary, random_weights, unit_states, with_mean_rates
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.scenes import scene, tensors
from training.evaluation.parts import ALL_BUT_ONE
from training.fit import long_chains, objects
from training.fit.configuration import ObjectsConfig
from training.fit.long_chains import fit_scene_rates, store_samples
from training.fit.objects import ObjectFit, ObjectScenes, random_parts, start_objects
from training.machines import MachineSpec, build, weights_of
from training.machines.gibbs import Chains

V = 4
EVERY = binary(V)
CONFIG = ObjectsConfig(steps=400, batch_size=128, learning_rate=0.05, warm_up=20, chains=64)
SPECS = {
    "binary": MachineSpec("rbm", V=V, A=1, units=3, C=2, profiles=2),
    "coupled": MachineSpec(
        "triway", V=V, A=1, units=2, states=3, C=2, K=1, profiles=2, coupled=True
    ),
}


def machine_of(name, scale=0.05, seed=0, **changes):
    machine = build(replace(SPECS[name], **changes))
    random_weights(machine, torch.Generator().manual_seed(seed), scale)
    return machine.requires_grad_(True)


def log_sum(machine, v, room=-1, source=-1):
    """log sum of exp(-E) over h1 of each row of v, without relations; differentiable."""
    h1 = unit_states(machine.spec).to(v.dtype)
    index = torch.cartesian_prod(*map(torch.arange, (len(v), len(h1)))).T
    v, h1 = (block[k] for block, k in zip((v, h1), index, strict=True))
    edges, r = machine.edges(torch.zeros(1, 0, dtype=torch.int64)), v[:, :0]
    conditions = (torch.full((len(v),), k) for k in (room, source))
    energy = machine.energy(v, r, h1, edges, *conditions)
    return (-energy).view(int(index[0].max()) + 1, -1).logsumexp(1)


def fit_objects(fit):
    """All steps of a fit."""
    while not fit.finished:
        fit.step()
    fit.finish()


def log_p(machine, *conditions):
    """log p(v | room, source) of every v, (2^V,)."""
    return log_sum(machine, EVERY.to(machine.b.dtype), *conditions).log_softmax(0)


def scenes_of(shows):
    """Scenes of two sources and three room types, each with two classes or more."""
    v = EVERY[EVERY.sum(1) >= 2].float().repeat(2, 1)
    source = torch.arange(2).repeat_interleave(len(v) // 2)
    room = torch.arange(len(v)) % 3 - 1
    v = v * shows[source]
    kept = v.sum(1) >= 2
    blocks = (block[kept] for block in (v, room, source, torch.ones(len(v))))
    return ObjectScenes(*blocks, shows, shows[source][kept], ("sunrgbd", "procthor"))


def target_scenes():
    """One source, whose scenes have the probabilities TARGET."""
    v = EVERY[EVERY.sum(1) >= 2].float()
    weight = 1000 * TARGET[EVERY.sum(1) >= 2].float()
    source = torch.zeros(len(v), dtype=torch.int64)
    return ObjectScenes(v, source - 1, source, weight, ALL[:1], ALL[source], ("sunrgbd",))


ALL = torch.ones(2, V, dtype=torch.bool)
PARTIAL = torch.tensor([[True, True, True, False], [True, True, True, True]])


def test_scenes_keep_classes_that_their_source_shows():
    """procthor shows class 0 twice only; sunrgbd has an open vocabulary and shows all; of the
    structure (class 4) nothing is learned; a scene of one class, a source of such scenes and a
    source of weight 0 go."""
    rows = [*[([0, 1, 4], "procthor")] * 2, *[([1, 2, 3], "procthor")] * 3, ([1, 4], "procthor")]
    rows += [([0, 3], "sunrgbd"), ([0, 2], "bddl"), ([1, 4], "house"), ([2], "house")]
    data = tensors([scene(classes, source=source) for classes, source in rows])
    config = CONFIG.model_copy(update={"source_weights": {"bddl": 0.0, "procthor": 0.5}})
    found = ObjectScenes.of(data, torch.arange(5) == 4, config)
    assert found.sources == ("procthor", "sunrgbd")
    assert found.shows.tolist() == [[False, True, True, True, False], [True] * 4 + [False]]
    assert found.v.tolist() == [[0, 1, 1, 1, 0]] * 3 + [[1, 0, 0, 1, 0]]
    assert found.source.tolist() == [0, 0, 0, 1]
    assert found.weight.tolist() == [0.5] * 3 + [1]
    count, total = torch.tensor([1.0, 1.5, 1.5, 2.5]), torch.tensor([1.0, 2.5, 2.5, 2.5])
    expected = ((count + 0.5) / (total - count + 0.5)).log()
    torch.testing.assert_close(found.log_odds()[:4], expected)
    open_too = config.model_copy(update={"open_sources": ("procthor",)})
    assert ObjectScenes.of(data, torch.arange(5) == 4, open_too).shows[0].tolist()[:4] == [True] * 4
    data.annotated_classes[data.source_names.index("sunrgbd"), 2] = False
    left_out = ObjectScenes.of(data, torch.arange(5) == 4, config)
    assert left_out.shows.tolist() == [
        [False, True, True, True, False],
        [True, True, False, True, False],
    ]
    with pytest.raises(ValueError, match="two classes"):
        ObjectScenes.of(tensors([scene([1])]), torch.arange(5) == 4, config)


def test_a_present_class_says_nothing_about_its_family():
    """2 < 1 < 0: class 2 is a kind of 1, and 1 a kind of 0; class 3 has no family."""
    related = torch.zeros(4, 4)
    for i, j in ((1, 0), (2, 1), (2, 0)):
        related[i, j] = related[j, i] = 1
    rows = [[1, 3], [2, 3], [0, 2]]
    data = replace(tensors([scene(row, source="house") for row in rows], 4), related=related)
    found = ObjectScenes.of(data, torch.zeros(4, dtype=torch.bool), CONFIG)
    # Present classes are known, and so are absent classes without a relative.
    assert found.observed.int().tolist() == [[0, 1, 0, 1], [0, 0, 1, 1], [1, 0, 1, 1]]
    # The log-odds of an unknown class change no loss.
    machine = machine_of("coupled", scale=0.7)
    losses = []
    for bias in (0.0, 3.0):
        with torch.no_grad():
            machine.b[0] = bias
        fit = ObjectFit(machine, replace(found, weight=torch.tensor([1.0, 1, 0])), CONFIG, seed=1)
        losses.append(float(fit._conditional_loss(torch.tensor([0, 1])).detach()))
    assert losses[0] == losses[1]


@given(st.integers(0, 2**32), st.floats(0, 1), st.integers(2, 30), st.floats(0.1, 1))
def test_parts_list_and_hide_at_least_one_class(seed, leave_one_out, classes, density):
    generator = torch.Generator().manual_seed(seed)
    v = (torch.rand(40, classes, generator=generator) < density).float()
    v[:, :2] = 1
    parts = random_parts(v, leave_one_out, generator)
    n, listed = v.sum(1), parts.listed.sum(1)
    assert bool((parts.listed <= v).all())
    assert bool(((listed >= 1) & (listed <= n - 1)).all())
    one = parts.share == ALL_BUT_ONE
    assert torch.equal(one, listed == n - 1)
    drawn = parts.weight > 1
    assert bool(one[drawn].all())
    assert torch.equal(parts.weight, torch.where(drawn, n, 1.0))
    share = listed / n
    bins = (share > 0.3 + 1e-5).int() + (share > 0.6 + 1e-5).int()
    assert torch.equal(bins[~one], parts.share[~one].int())


def test_shares_of_random_parts():
    """Of 40,000 scenes of 40 classes: five standard errors, so chance fails with p < 1e-5."""
    count, n = 40_000, 40
    v = torch.zeros(count, 50)
    v[:, 5:45] = 1
    parts = random_parts(v, 0.3, torch.Generator().manual_seed(0))
    one = parts.weight > 1
    assert float(one.float().mean()) == pytest.approx(0.3, abs=5 * (0.21 / count) ** 0.5)
    listed = parts.listed[~one].sum(1)
    # A share of U(.05, 1), rounded, at most 39 of 40: every number has the same chance but the
    # first, of half a step, and the last, of one and a half.
    frequency = torch.bincount(listed.long(), minlength=n)[2:] / len(listed)
    expected = torch.full((n - 2,), 1 / 38)
    expected[0], expected[-1] = 0.5 / 38, 1.5 / 38
    assert bool(((frequency - expected).abs() <= 5 * (expected / len(listed)).sqrt()).all())
    of_class = parts.listed[one].mean(0)[5:45]
    error = 5 * (1 / 40 * 39 / 40 / float(one.sum())) ** 0.5
    assert float((of_class - 39 / 40).abs().max()) <= error


def source_logit(machine, shows, x, q):
    """f_q plus the base rates of the list x in source q. The rate of a class that q does not show
    is the mean of the sources that show it."""
    total = machine.f[q]
    for i in x.nonzero().flatten().tolist():
        sources = [q] if shows[q, i] else [p for p in range(len(shows)) if shows[p, i]]
        total = total + sum(machine.a[p, i] for p in sources) / len(sources)
    return total


def masked_loss(machine, scenes, parts, index, listed_room):
    """The loss of a batch, with each probability as a sum over all states of the hidden units."""
    total = torch.zeros((), dtype=torch.float64)
    for row, k in enumerate(index.tolist()):
        source, room = int(scenes.source[k]), int(listed_room[row])
        x, v = parts.listed[row], scenes.v[k]
        for i in range(V):
            if x[i] or not scenes.shows[source, i]:
                continue
            both = torch.stack([x, x.index_fill(0, torch.tensor(i), 1.0)])
            off, on = log_sum(machine, both, room, source)
            log_odds = on - off + machine.kappa[parts.share[row], i]
            weight = float(parts.weight[row]) if v[i] else 1.0
            total = total + weight * softplus(-log_odds if v[i] else log_odds)
        logits = [source_logit(machine, scenes.shows, x, q) for q in range(len(scenes.shows))]
        total = total - CONFIG.source_loss * torch.stack(logits).log_softmax(0)[source]
        true = int(scenes.room[k])
        if room < 0 <= true:
            every = torch.cat([log_sum(machine, x[None], t, source) for t in range(2)])
            total = total - CONFIG.room_loss * every.log_softmax(0)[true]
    return total / len(index)


@pytest.mark.parametrize("name", SPECS)
def test_the_masked_loss_and_its_gradient(name, monkeypatch):
    """Equal to a formula of its own, with the weights of hidden classes and partial labels. A class
    that a source does not show is no evidence for or against this source."""
    machine = machine_of(name, scale=0.7).double()
    machine.u.requires_grad_(False).zero_()  # the answers leave u out
    scenes = scenes_of(PARTIAL)
    scenes = replace(scenes, v=scenes.v.double())
    fit = ObjectFit(machine, scenes, CONFIG, seed=3)
    kept = {}

    def parts_of(v, leave_one_out, generator):
        kept["parts"] = random_parts(v, leave_one_out, generator)
        return kept["parts"]

    def rooms(v, *, room, **options):
        kept["room"] = room
        return type(machine).object_log_odds(machine, v, room=room, **options)

    monkeypatch.setattr(objects, "random_parts", parts_of)
    monkeypatch.setattr(machine, "object_log_odds", rooms)
    index = scenes.draw(60, torch.Generator().manual_seed(1))
    loss = fit._conditional_loss(index)
    every = ("b", "c1", "e", "W", "Q", "L", "Y", "f", "a", "y", "kappa")
    names = [name for name in every if hasattr(machine, name)]
    weights = [machine.get_parameter(n) for n in names]
    found = torch.autograd.grad(loss, weights)
    # Of 40 scenes with a room type, 15 % list it: 6 on average.
    assert 1 < int((kept["room"] >= 0).sum()) < 15
    by_hand = masked_loss(machine, scenes, kept["parts"], index, kept["room"])
    assert loss.item() == pytest.approx(by_hand.item(), rel=1e-6)
    expected = torch.autograd.grad(by_hand, weights)
    for own, gradient, other in zip(names, found, expected, strict=True):
        pair = (applied(own, gradient), applied(own, other))
        torch.testing.assert_close(*pair, rtol=1e-5, atol=1e-8)
        assert gradient.abs().max() > 1e-3
    # Source 0 does not show class 3.
    assert found[names.index("a")][0, 3] == 0
    assert found[names.index("a")][1, 3] != 0


def applied(name, gradient):
    """The gradient as a step applies it: couplings stay symmetric with a diagonal of 0."""
    return (gradient + gradient.T).fill_diagonal_(0) / 2 if name == "L" else gradient


KINDS = [(-1, 0), (-1, 1), (1, 0), (0, 1)]
"""Room types and sources of chains."""


@pytest.mark.parametrize("name", SPECS)
def test_the_generative_gradient_is_that_of_the_likelihood(name):
    """-log p(v | room type, source) of the classes that a source shows. With 40,000 chains of each
    kind, drawn exactly: every entry is a difference of means of values in [-1, 1], so six standard
    errors are below .02; fails by chance with p < 1e-6."""
    machine = machine_of(name, scale=0.8)
    fit = ObjectFit(machine, scenes_of(PARTIAL), CONFIG, seed=0)
    machine.double()
    generator, count = torch.Generator().manual_seed(1), 40_000
    drawn, exact, data = [], torch.zeros((), dtype=torch.float64), EVERY[[7, 13, 3, 6]]
    for v, (room, source) in zip(data, KINDS, strict=True):
        possible = EVERY[(PARTIAL[source] >= EVERY).all(1)]
        log_q = log_sum(machine, possible, room, source).log_softmax(0)
        pick = log_q.detach().exp().multinomial(count, replacement=True, generator=generator)
        drawn.append(possible[pick])
        v *= PARTIAL[source]
        exact = exact - log_q[(possible == v).all(1)][0] / len(KINDS)
    room, source = torch.tensor(KINDS).T
    many = source.repeat_interleave(count)
    rooms = room.repeat_interleave(count)
    chains = Chains(torch.cat(drawn), rooms, many, PARTIAL[many])
    names = [n for n in ("b", "c1", "W", "Q", "L", "a", "e") if hasattr(machine, n)]
    weights = [machine.get_parameter(n) for n in names]
    found = torch.autograd.grad(fit._generative_loss(chains, data, room, source), weights)
    expected = torch.autograd.grad(exact, weights, allow_unused=True, materialize_grads=True)
    for weight, gradient, other in zip(names, found, expected, strict=True):
        pair = (applied(weight, gradient), applied(weight, other))
        torch.testing.assert_close(*pair, rtol=0, atol=0.02)
        assert (gradient.abs().max() > 0.02) == (weight != "e")


def test_the_priors_decay_the_weights_and_couplings_stay_symmetric():
    """The first step of Adam moves each weight by its rate, against the sign of the gradient.
    Without scenes of a second source, the row of its rates has the gradient of the prior alone."""
    machine = machine_of("coupled", scale=1.0)
    scenes = replace(scenes_of(ALL), weight=(scenes_of(ALL).source == 0).float())
    config = CONFIG.model_copy(update={"generative_weight": 0.0, "source_loss": 0.0})
    before = machine.a[1].detach().clone()
    fit = ObjectFit(machine, scenes, config, seed=0)
    fit.step()
    rate = config.learning_rate / config.warm_up
    torch.testing.assert_close(machine.a[1].detach(), before - rate * before.sign())
    couplings = machine.couplings.detach()
    assert torch.equal(couplings, couplings.T)
    assert not couplings.diagonal().any()
    decays = {id(g["params"][0]): g["weight_decay"] for g in fit._optimiser.param_groups}
    size = float(scenes.weight.sum())
    for names, precision in (("WQ", 1.5), ("LY", 5.0), (("a", "y", "kappa"), 7.5), ("b", 0.0)):
        for name in names:
            assert decays[id(machine.get_parameter(name))] == pytest.approx(precision / size)


def test_finished_couplings_are_symmetric_to_the_last_bit():
    """The optimiser rounds the last entries of a matrix differently: 22² leaves some over."""
    many = 22
    generator = torch.Generator().manual_seed(0)
    v = (torch.rand((60, many), generator=generator) < 0.4).float()
    v[:, :2] = 1
    shows = torch.ones((1, many), dtype=torch.bool)
    zeros = torch.zeros(60, dtype=torch.int64)
    known = shows[zeros]
    scenes = ObjectScenes(v, zeros - 1, zeros, torch.ones(60), shows, known, ("here",))
    spec = MachineSpec("rbm", V=many, A=1, units=2, states=3, C=1, profiles=1, coupled=True)
    machine = build(spec).initialise(generator, 0.05)
    config = CONFIG.model_copy(update={"steps": 30})
    fit_objects(ObjectFit(machine, scenes, config, seed=0))
    couplings = machine.couplings.detach()
    assert couplings.any()
    assert torch.equal(couplings, couplings.T)


def context(likely):
    p = torch.tensor(likely).double()
    return torch.where(EVERY > 0, p, 1 - p).prod(1)


TARGET = 0.6 * context((0.9, 0.9, 0.1, 0.15)) + 0.4 * context((0.1, 0.1, 0.9, 0.85))
TARGET = torch.where(EVERY.sum(1) >= 2, TARGET, 0) / TARGET[EVERY.sum(1) >= 2].sum()
"""Two contexts, in scenes of at least two classes."""


@pytest.mark.parametrize("name", SPECS)
def test_the_generative_share_brings_samples_near_the_scenes(name):
    """By the divergence of the enumerated p(v) from the scenes, in nats."""

    def divergence(weight):
        config = CONFIG.model_copy(update={"generative_weight": weight, "rate_prior": 1e4})
        machine = machine_of(name, scale=0.1, seed=1, profiles=1)
        fit_objects(ObjectFit(machine, target_scenes(), config, seed=0))
        q = log_p(machine.double()).detach()
        seen = TARGET > 0
        return float((TARGET[seen] * (TARGET[seen].log() - q[seen])).sum())

    assert divergence(2.0) < 0.6 * divergence(0.0)


def test_only_object_weights_are_trained():
    machine = machine_of("coupled", scale=0.3)
    before = {name: w.detach().clone() for name, w in machine.named_parameters()}
    fit = ObjectFit(machine, scenes_of(ALL), CONFIG, seed=0)
    fit.step()
    for name, weight in machine.named_parameters():
        is_changed = not torch.equal(weight, before[name])
        assert is_changed == (name in objects.OBJECT_WEIGHTS and weight.numel() > 0), name


@pytest.mark.parametrize("served", [{}, {"sunrgbd": 1.0, "procthor": 0.25}])
def test_the_served_mix_moves_into_b_and_keeps_the_rates_of_each_source(served):
    config = CONFIG.model_copy(update={"steps": 30, "served_sources": served})
    machine, scenes = machine_of("coupled"), scenes_of(PARTIAL)
    fit = ObjectFit(machine, scenes, config, seed=0)
    while not fit.finished:
        fit.step()
    b, a, f = (fit._average[name].clone() for name in "baf")
    fit.finish()
    weight = torch.tensor([1.0, served.get("procthor", 1.0)])
    mix = (weight @ a) / weight.sum()
    mix[3] = a[0, 3] = a[1, 3]  # of the one source that shows class 3
    torch.testing.assert_close(machine.b, b + mix)
    torch.testing.assert_close(machine.b + machine.a, b + a)
    torch.testing.assert_close(weight @ machine.a, torch.zeros(V), rtol=0, atol=1e-6)
    assert not machine.a[:, 3].any()
    share = torch.bincount(scenes.source) / len(scenes.source)
    torch.testing.assert_close(machine.f, f + (weight / weight.sum() / share).log())
    torch.testing.assert_close(machine.L, machine.L.T)
    assert not machine.L.diagonal().any()


@torch.no_grad()
def test_b_is_the_bias_without_a_list_before_training():
    """f starts with the sizes of the sources, and ends with their weights in the served mix."""
    config = CONFIG.model_copy(update={"served_sources": {"sunrgbd": 1.0, "procthor": 0.25}})
    machine, scenes = machine_of("coupled", scale=1.0), scenes_of(PARTIAL)
    start_objects(machine, scenes)
    torch.testing.assert_close(machine.f.exp(), torch.bincount(scenes.source) / len(scenes.v))
    ObjectFit(machine, scenes, config, seed=0).finish()
    nothing = torch.zeros(1, V)
    torch.testing.assert_close(machine.source_weights(nothing, None)[0], torch.tensor([0.8, 0.2]))
    weights = weights_of(machine)
    p = weights.source_weights(np.zeros(0, np.int64), np.zeros((1, 0), np.float32), None)
    np.testing.assert_allclose(p @ weights["a"], np.zeros((1, V)), rtol=0, atol=1e-6)


def test_weights_are_averaged_over_the_last_steps():
    """The last 30 % of 10 steps are 3."""
    machine = machine_of("binary")
    fit = ObjectFit(machine, scenes_of(ALL), CONFIG.model_copy(update={"steps": 10}), seed=0)
    steps = []
    while not fit.finished:
        fit.step()
        steps.append(machine.W.detach().clone())
    fit.finish()
    torch.testing.assert_close(machine.W.detach(), torch.stack(steps[-3:]).mean(0))


def test_popularity_of_the_served_mix():
    """A class that no scene shows is NaN."""
    scenes = scenes_of(PARTIAL)
    scenes = replace(scenes, v=scenes.v * (torch.arange(V) != 1))
    config = CONFIG.model_copy(update={"served_sources": {"sunrgbd": 1.0, "procthor": 0.5}})
    share = []
    for q in range(2):
        own = scenes.v[scenes.source == q]
        share.append((own.sum(0) + 0.5) / (len(own) + 1))
    expected = (share[0] + 0.5 * share[1]) / 1.5
    expected[3] = share[1][3]
    popularity = objects.served_popularity(scenes, config)
    is_shown = torch.arange(V) != 1
    torch.testing.assert_close(popularity[is_shown], expected.logit()[is_shown])
    assert torch.equal(popularity.isnan(), ~is_shown)


@torch.no_grad()
@pytest.mark.parametrize("name", SPECS)
def test_stored_samples_follow_the_machine_under_their_room_types(name):
    """3,000 chains: each of 3 x 16 shares within five standard errors (p < 3e-5 by chance)."""
    machine, scenes = machine_of(name, scale=0.8, N=3000), scenes_of(ALL)
    store_samples(machine, scenes, seed=0)
    found, rooms = (
        torch.from_numpy(unpack_scenes(machine.fantasies.numpy(), V)),
        machine.fantasy_rooms,
    )
    sets = (found @ torch.tensor([1.0, 2, 4, 8])).long()
    assert set(rooms.tolist()) == {-1, 0, 1}
    machine = with_mean_rates(machine)
    for room in (-1, 0, 1):
        own = sets[rooms == room]
        share = torch.bincount(own, minlength=16).double() / len(own)
        p = log_p(machine, room).exp()
        assert bool(((share - p).abs() <= 5 * (p * (1 - p) / len(own)).sqrt()).all())


SHOWS = torch.tensor([[True] * V, [True, True, True, False]])
SERVED = ObjectsConfig(served_sources={"sunrgbd": 2.0, "procthor": 1.0})


def fitted(name):
    machine, scenes = machine_of(name, scale=0.6), scenes_of(SHOWS)
    with torch.no_grad():
        machine.u.zero_()
        fit_scene_rates(machine, scenes, SERVED, seed=0)
    return machine.requires_grad_(False), scenes


def exact_shares(machine, scenes, population):
    """p(v_i = 1) in chains that keep the room types of the scenes, (V,), by enumeration."""
    source = -1 if population.profile is None else population.profile
    total = torch.zeros(V).double()
    for room in scenes.room.unique().tolist():
        weight = float(population.weight[(scenes.room == room).numpy()].sum())
        total += weight * (log_p(machine, room, source).double().exp() @ EVERY)
    return total.numpy()


@pytest.mark.parametrize("name", SPECS)
def test_long_chains_have_the_shares_of_the_scenes(name):
    """Of each source and of the served mix, without classes that the source cannot show."""
    machine, scenes = fitted(name)
    for population in long_chains.populations(scenes, SERVED):
        exact = exact_shares(machine, scenes, population)[population.shows]
        np.testing.assert_allclose(exact, population.p[population.shows], atol=0.02)
    assert not machine.u[1, 3]


@pytest.mark.parametrize(
    ("second", "served", "weights"),
    [
        ("procthor", {"sunrgbd": 2.0, "procthor": 1.0}, [2 / 3, 1 / 3]),
        ("procthor", {"3dssg": 1.0}, [1 / 2, 1 / 2]),  # no served source has scenes
        # Beside a source of whole rooms, lists of camera frames do not count.
        ("virtualhome", {"sunrgbd": 2.0, "virtualhome": 1.0}, [0, 1]),
    ],
)
def test_the_served_mix_weighs_its_sources(second, served, weights):
    scenes = replace(scenes_of(SHOWS), sources=("sunrgbd", second))
    config = ObjectsConfig(served_sources=served)
    *by_source, mixed = long_chains.populations(scenes, config)
    for q, population in enumerate(by_source):
        own = scenes.v[scenes.source == q].double().mean(0)
        np.testing.assert_allclose(population.p, own)
    np.testing.assert_allclose(mixed.p, weights @ np.stack([one.p for one in by_source]))
    shown = SHOWS[np.array(weights) > 0].any(0)
    np.testing.assert_array_equal(mixed.shows, shown)


def test_served_scenes_of_long_chains_are_the_plausible_ones():
    """A scene of fewer than two classes is drawn again, seven times. 512 chains of 40 states; each
    share is within .03 of its enumerated value. Neighbouring states are 50 sweeps apart, so the
    share of a chain has an error of at most .5 / sqrt(40 / 8), and the mean over chains one of .01.
    A share fails by chance with a probability below .003."""
    machine, scenes = fitted("coupled")
    *_, population = long_chains.populations(scenes, SERVED)
    population = replace(population, room=np.full_like(population.room, -1))
    artifact = artifact_of(machine, smallest=(2,) * (machine.spec.C + 1))
    long = long_chains.LongChains(
        long_chains.scene_chains(weights_of(machine)), scenes, population, 512, seed=2
    )
    long.run(100)
    drawn = long_chains.served_frequencies(artifact, long, 40).mean(0)
    p = log_p(machine, -1, -1).double().exp()
    is_small = EVERY.sum(1) < 2
    refused = float(p[is_small].sum())
    assert 0.05 < refused < 0.95
    weight = torch.where(is_small, refused**8 / refused, (1 - refused**8) / (1 - refused))
    expected = ((p * weight) @ EVERY.double()).numpy()
    np.testing.assert_allclose(drawn, expected, atol=0.03)


def test_chains_start_at_each_room_type_in_proportion():
    scenes = scenes_of(SHOWS)
    mixed = list(long_chains.populations(scenes, SERVED))[-1]
    rooms = mixed.room[mixed.draw(300, np.random.default_rng(0))]
    for room in (-1, 0, 1):
        assert abs((rooms == room).sum() - 300 * mixed.weight[mixed.room == room].sum()) <= 1


def test_only_a_drift_beyond_its_limit_is_an_objection(monkeypatch):
    monkeypatch.setattr(long_chains, "_CHAINS", 64)
    machine, scenes = fitted("coupled")
    assert long_chains.measure_drift(artifact_of(machine), scenes, SERVED).objection() is None
    mix = machine.u[-1].clone()
    machine.u[-1] -= 3.0
    drift = long_chains.measure_drift(artifact_of(machine), scenes, SERVED)
    assert drift.size < -0.5
    assert "after 3000 sweeps, generated scenes have -" in drift.objection()
    machine.u[-1] = mix + torch.tensor([9.0, -9.0, 0.0, 0.0])
    drift = long_chains.measure_drift(artifact_of(machine), scenes, SERVED)
    assert drift.label == "lamp"
    assert drift.share == pytest.approx(-1, abs=0.01)
    metrics = {metric.metric: metric for metric in drift.metrics()}
    assert metrics["largest change of a class"].value == pytest.approx(drift.share, abs=1e-4)
