"""Fit the object weights as a robot asks: by random parts of scenes.

A robot lists a few objects of a room and asks for the rest. Each step shows a random part of each
scene. The loss is the negative log-likelihood of every class that is not listed:

    loss = mean over scenes of sum_i [ζ(λ_i) - v_i λ_i] - k log p(t | listed) - s log p(q | listed)
           + g [F(v) - F(chains)]

λ_i is the closed-form log-odds of class i given the listed classes (`BoltzmannMachine`), and ζ the
softplus.

- 30 % of the parts list all classes but one, which counts as often as the scene has classes. The
  other parts list a share of U(.05, 1) of the classes.
- The room type t is listed in 15 % of the parts. If not, its cross-entropy has the weight k.
- A class that a source shows in fewer than 3 scenes has no term there (partial labels). Structure
  has none, and unlisted relatives of a present class (`Vocabulary.related`) have none: a desk lamp
  is a lamp, and an annotator may call it so.
- Each source q has its own base rates a_q and y_q, and each listed share its own bias kappa. The
  machine also learns p(q | listed), with the weight s, because a robot's list names no source.
- With the weight g, persistent Gibbs chains (PCD) keep samples of the machine like scenes. The
  chains of a source have its base rates.

Normal priors, divided by the number of scenes, keep the machine from learning scenes by heart.

Sources: Besag, "Statistical analysis of non-lattice data" (1975), for conditional likelihoods;
Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008), for PCD.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import cross_entropy, nll_loss, softplus
from torch.nn.utils.parametrize import cached

from training.datasets.batches import SceneTensors
from training.datasets.sources import SOURCES
from training.evaluation.parts import share_bin
from training.fit.configuration import ObjectsConfig
from training.machines import BoltzmannMachine
from training.machines.gibbs import Chains, sweep
from training.machines.machine import OBJECT_WEIGHTS

_SHOWN = 3  # scenes of a source in which a class must occur
_LEAST_SHARE = 0.05
_AVERAGED = 0.3  # last share of the steps whose weights are averaged
_RARE = -9.0  # least initial bias of a class
_UNSERVED = 1e-9  # weight of a source outside of the served mix


@dataclass(frozen=True)
class ObjectScenes:
    """The N training scenes of objects: they have at least two classes, and a weight above 0."""

    v: Float[Tensor, "N V"]  # presence of the classes that the source shows, without structure
    room: Int[Tensor, "N"]  # room type; -1 where unknown
    source: Int[Tensor, "N"]  # index in `sources`
    weight: Float[Tensor, "N"]
    shows: Bool[Tensor, "sources V"]  # classes that a source shows
    observed: Bool[Tensor, "N V"]  # classes whose presence or absence the scene shows
    sources: tuple[str, ...]  # names

    @classmethod
    def of(cls, train: SceneTensors, structure: Bool[Tensor, "V"], config: ObjectsConfig) -> Self:
        """Choose the usable training scenes, and the classes that each data source can show.

        Raises:
            ValueError: no scene is usable.
        """
        names, annotated = train.source_names, train.annotated_classes
        source_weights = torch.tensor([config.source_weights.get(q, 1.0) for q in names])
        counts = torch.zeros(annotated.shape).index_add_(0, train.source, (train.v > 0).float())
        # Own sources and open vocabularies show every class but incompletely annotated ones.
        is_open = [q not in SOURCES or SOURCES[q].open_vocabulary for q in names]
        shows_all = [q in config.open_sources for q in names] if config.open_sources else is_open
        public_open = torch.tensor([q in SOURCES for q in names]) & torch.tensor(is_open)
        incomplete = public_open.unsqueeze(1) & ~annotated
        shows = (counts >= _SHOWN) & annotated | torch.tensor(shows_all).unsqueeze(1) & ~incomplete
        shows &= ~structure
        v = (train.v > 0) & shows[train.source]
        weight = train.weight * source_weights[train.source]
        usable = ((weight > 0) & (v.sum(1) >= 2)).nonzero().squeeze(1)
        if not len(usable):
            raise ValueError("no training scene has two classes; add scenes with more objects")
        # Sources without a usable scene have no entry, so the indices of sources change.
        used, source = train.source[usable].unique(return_inverse=True)
        sources, v = tuple(names[q] for q in used.tolist()), v[usable]
        observed = shows[used][source] & (v | ~train.relatives_of(v.float()))
        return cls(
            v=v.float(), room=train.room[usable], source=source, weight=weight[usable],
            shows=shows[used], observed=observed, sources=sources,
        )  # fmt: skip

    @property
    def size(self) -> float:
        """Sum of the weights of the scenes."""
        return float(self.weight.sum())

    def draw(self, count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
        """Return indices of scenes, drawn in proportion to their weights."""
        return torch.multinomial(self.weight, count, replacement=True, generator=generator)

    @property
    def source_sizes(self) -> Float[Tensor, "sources"]:
        """Sum of the weights of the scenes of each source."""
        return torch.zeros(len(self.sources)).index_add_(0, self.source, self.weight)

    @property
    def shows_rooms(self) -> Bool[Tensor, "sources 1"]:
        """True for a source of two room types: one of bedrooms cannot show their frequency."""
        kinds = [self.room[self.source == q] for q in range(len(self.sources))]
        return torch.tensor([[len(room[room >= 0].unique()) > 1] for room in kinds])

    def log_odds(self) -> Float[Tensor, "V"]:
        """Return the smoothed log-odds of each class in the scenes that can show it."""
        count = (self.v * self.weight.unsqueeze(1)).sum(0)
        total = (self.shows * self.source_sizes.unsqueeze(1)).sum(0)
        total = torch.where(total > 0, total, self.size)
        return ((count + 0.5) / (total - count + 0.5)).log()


class Parts(NamedTuple):
    """Random parts of scenes."""

    listed: Float[Tensor, "B V"]  # 1 for listed classes
    share: Int[Tensor, "B"]  # bin of the listed share; see `share_bin`
    weight: Float[Tensor, "B"]  # weight of a hidden class that is present


def random_parts(
    v: Float[Tensor, "B V"], leave_one_out: float, generator: torch.Generator
) -> Parts:
    """List a random part of each scene; a share `leave_one_out` of the parts hides one class."""
    n = v.sum(1)  # number of classes of each scene
    hides_one = torch.rand(len(v), generator=generator) < leave_one_out
    share = _LEAST_SHARE + (1 - _LEAST_SHARE) * torch.rand(len(v), generator=generator)
    count = torch.where(hides_one, n - 1, (share * n).round().clamp(min=1).minimum(n - 1))
    # Listed are the `count` present classes with the smallest random keys; absent ones are above 2.
    keys = torch.rand(v.shape, generator=generator) + 2 * (1 - v)
    smallest = keys.topk(int(count.max()), largest=False).values
    listed = v * (keys <= smallest.gather(1, count.long().unsqueeze(1) - 1))
    return Parts(listed, share_bin(count, n), torch.where(hides_one, n, 1.0))


class ObjectFit:
    """The fit of the object weights of a machine. It can stop after each step and continue."""

    def __init__(
        self, machine: BoltzmannMachine, scenes: ObjectScenes, config: ObjectsConfig, seed: int
    ) -> None:
        """Prepare the optimiser of the object weights and, if the loss has them, the chains."""
        self.machine, self.scenes, self.config = machine, scenes, config
        self.steps, self.loss = 0, math.nan
        self._generator = torch.Generator().manual_seed(seed)
        # A weight that classes share by word vectors has a name such as "parametrizations.W.0.map".
        self._weights = {
            name: weight
            for name, weight in machine.named_parameters()
            if name.removeprefix("parametrizations.").split(".")[0] in OBJECT_WEIGHTS
        }
        self._average = {name: w.detach().clone() for name, w in self._weights.items()}
        # The normal priors, divided by the number of scenes, act as weight decay.
        groups = [
            {"params": [weight], "weight_decay": config.precision_of(name) / scenes.size}
            for name, weight in self._weights.items()
        ]
        self._optimiser = torch.optim.Adam(groups, lr=config.learning_rate, fused=True)
        self._chains: Chains | None = None
        if config.generative_weight:
            index = scenes.draw(config.chains, self._generator)
            source = scenes.source[index]
            rooms = self._some_rooms(scenes.room[index])
            self._chains = Chains(scenes.v[index], rooms, source, scenes.shows[source])

    @property
    def finished(self) -> bool:
        """True after the last step."""
        return self.steps >= self.config.steps

    def step(self) -> None:
        """Update the weights by one batch of random parts."""
        config = self.config
        with cached():
            loss = self._batch_loss()
        self.loss = float(loss.detach())
        if not math.isfinite(self.loss):
            raise FloatingPointError(
                "the object weights diverged in training: lower objects.learning_rate"
            )
        for group in self._optimiser.param_groups:
            group["lr"] = config.learning_rate * self._schedule()
        self._optimiser.zero_grad()
        loss.backward()
        if (couplings := self.machine.couplings) is not None and couplings.grad is not None:
            # A symmetric gradient keeps the couplings L symmetric, with a diagonal of 0.
            couplings.grad = (couplings.grad + couplings.grad.T).fill_diagonal_(0).div_(2)
        self._optimiser.step()
        self.steps += 1
        self._add_to_average()

    def _batch_loss(self) -> Tensor:
        """Return the loss of the module over a random batch of scenes."""
        scenes = self.scenes
        index = scenes.draw(self.config.batch_size, self._generator)
        loss = self._conditional_loss(index)
        if self._chains is not None:
            room = self._some_rooms(scenes.room[index])
            difference = self._generative_loss(
                self._chains, scenes.v[index], room, scenes.source[index]
            )
            loss = loss + self.config.generative_weight * difference
        return loss

    def _conditional_loss(self, index: Int[Tensor, "B"]) -> Float[Tensor, ""]:
        """Return the mean over scenes of the negative log-likelihood of unlisted variables."""
        machine, scenes = self.machine, self.scenes
        v, room, source = scenes.v[index], scenes.room[index], scenes.source[index]
        parts = random_parts(v, self.config.leave_one_out, self._generator)
        listed_room = self._some_rooms(room)
        log_odds = machine.object_log_odds(
            parts.listed, room=listed_room, source=source, share=parts.share
        )
        hidden = v - parts.listed  # 1 for present classes that are not listed
        weight = scenes.observed[index] * (1 - parts.listed)
        weight = weight * torch.where(hidden > 0, parts.weight.unsqueeze(1), 1.0)
        loss = ((softplus(log_odds) - hidden * log_odds) * weight).sum()
        # The data source given the listed classes.
        rates, _ = with_served_rates(machine.a, scenes.shows, served_weights(scenes, self.config))
        logits = machine.f + parts.listed @ rates.T
        loss = loss + self.config.source_loss * cross_entropy(logits, source, reduction="sum")
        is_hidden = (listed_room < 0) & (room >= 0)
        if bool(is_hidden.any()):
            log_p = machine.room_log_p(parts.listed[is_hidden], source[is_hidden])
            loss = loss + self.config.room_loss * nll_loss(log_p, room[is_hidden], reduction="sum")
        return loss / len(v)

    def _some_rooms(self, room: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """Return the room types, with those outside of `room_share` unknown (-1)."""
        is_listed = torch.rand(len(room), generator=self._generator) < self.config.room_share
        return torch.where(is_listed, room, -1)

    def _generative_loss(
        self,
        chains: Chains,
        v: Float[Tensor, "B V"],
        room: Int[Tensor, "B"],
        source: Int[Tensor, "B"],
    ) -> Float[Tensor, ""]:
        """Return F(scenes) - F(chains) given the room types, which the chains keep."""
        sweep(self.machine, chains, self._generator, classes=self.config.classes_per_sweep)
        count = len(v)
        v, room, source = (
            torch.cat(pair)
            for pair in ((v, chains.v), (room, chains.room), (source, chains.source))
        )
        # F given the room type: the bias of the room type cancels.
        free = self.machine.free_energy(v, room, source) + self.machine.room_rate(room, source)
        return free[:count].mean() - free[count:].mean()

    def _schedule(self) -> float:
        """Return the factor of the learning rate: it rises, stays, and falls along a cosine."""
        total, done = self.config.steps, self.steps
        if done < self.config.warm_up:
            return (done + 1) / self.config.warm_up
        if done < total / 2:
            return 1.0
        return 0.5 * (1 + math.cos(math.pi * (2 * done / total - 1)))

    @torch.no_grad()
    def _add_to_average(self) -> None:
        """Update the mean of the weights over the last share `_AVERAGED` of the steps."""
        count = self.steps - int((1 - _AVERAGED) * self.config.steps)
        for name, weight in self._weights.items() if count > 0 else ():
            self._average[name].lerp_(weight, 1 / count)

    @torch.no_grad()
    def finish(self) -> None:
        """Set the weights to their average, with the base rates of the served mix in b."""
        for name, weight in self._weights.items():
            weight.copy_(self._average[name])
        machine, scenes = self.machine, self.scenes
        if (couplings := machine.couplings) is not None:
            # The optimiser rounds the two halves differently, in its last bits.
            couplings.copy_((couplings + couplings.T).div_(2))
        # Then a[q] is the difference of source q from the mix, whose log weights are in f.
        served = served_weights(scenes, self.config)
        for rates, bias, shows in (
            (machine.a, machine.b, scenes.shows),
            (machine.y, machine.e, scenes.shows_rooms),
        ):
            complete, mix = with_served_rates(rates, shows, served)
            rates.copy_(complete - mix)
            bias.add_(mix)
        served = served.clamp(min=_UNSERVED)
        # p(q) becomes the share of the source in the served mix, instead of that in training.
        machine.f.add_((served / served.sum() * scenes.size / scenes.source_sizes).log())


def with_served_rates(
    rates: Float[Tensor, "sources k"],
    shows: Bool[Tensor, "sources k|1"],
    served: Float[Tensor, "sources"],
) -> tuple[Float[Tensor, "sources k"], Float[Tensor, "k"]]:
    """Return the rates of sources, completed by the mean over the served sources, and this mean.

    A source that does not show a class (or room types) gets the mean as its rate. `served` has the
    weights of the sources in the mean.
    """
    weights = served.unsqueeze(1) * shows
    mean = (weights * rates).sum(0) / weights.sum(0).clamp(min=1e-9)
    return torch.where(shows, rates, mean), mean


def served_popularity(scenes: ObjectScenes, config: ObjectsConfig) -> Float[Tensor, "V"]:
    """Return the log-odds of each class in a scene of the served mix; NaN without scenes.

    A class that no served source shows has the lowest rate of all.
    """
    count = torch.zeros(scenes.shows.shape)
    count.index_add_(0, scenes.source, scenes.v * scenes.weight.unsqueeze(1))
    share = (count + 0.5) / (scenes.source_sizes.unsqueeze(1) + 1)
    served = served_weights(scenes, config)
    _, mean = with_served_rates(share, scenes.shows, served)
    rate = torch.where(served @ scenes.shows.float() > 0, mean, share.amin())
    return torch.where(scenes.v.any(0), rate.logit(), torch.nan)


def served_weights(scenes: ObjectScenes, config: ObjectsConfig) -> Float[Tensor, "sources"]:
    """Return the weight of each source in the served mix."""
    served = config.served_sources or dict.fromkeys(scenes.sources, 1.0)
    return torch.tensor([served.get(q, 0.0) for q in scenes.sources])


def start_objects(machine: BoltzmannMachine, scenes: ObjectScenes) -> None:
    """Set the biases of classes to their log-odds in the scenes, and f to the sizes of sources."""
    with torch.no_grad():
        machine.f.copy_((scenes.source_sizes / scenes.size).log())
        machine.b.copy_(scenes.log_odds().clamp(min=_RARE))
