"""Which machines are compared with each other: those that learn from the same scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from training.config import Config, ConfigError, DataConfig, load_config, shipped_configs

DOMAINS = ("indoor", "everyday")
"""Measured when no configuration is given."""

_VARIANTS = ("triway", "gbm", "rbm")


@dataclass(frozen=True)
class Domain:
    """Configurations of one data section.

    Attributes:
        name: of its folder and its tables: that of its first configuration, less its last word.
        configs: the first is compared with all other rows.
    """

    name: str
    configs: tuple[Config, ...]

    @property
    def data(self) -> DataConfig:
        """The scenes of all of them."""
        return self.configs[0].data

    @property
    def leaks(self) -> bool:
        """Scenes of one group are in several parts: near-duplicates of what is asked are learnt."""
        return self.data.split == "random"

    def split_at_random(self) -> Domain:
        """The same under the seed paper's split: every scene on its own."""
        data = self.data.model_copy(update={"split": "random"})
        changed = [config.model_copy(update={"data": data}) for config in self.configs]
        return Domain(self.name, tuple(changed))


def default_configs() -> list[str]:
    """The shipped configurations of `DOMAINS`, the Triway machine of each first."""
    names = [f"{domain}-{variant}" for domain in DOMAINS for variant in _VARIANTS]
    return [name for name in names if name in shipped_configs()]


def read_domains(references: Sequence[str]) -> list[Domain]:
    """The domains of some configurations, in the order in which they are first named.

    Raises:
        ConfigError: a configuration cannot be read, two have one name, or two domains would.
    """
    groups: dict[DataConfig, list[Config]] = {}
    for reference in references:
        config = load_config(reference)
        if any(config.name == other.name for group in groups.values() for other in group):
            raise ConfigError(f"two configurations are called {config.name}")
        groups.setdefault(config.data, []).append(config)
    domains: dict[str, Domain] = {}
    for configs in groups.values():
        name = configs[0].name.rpartition("-")[0] or configs[0].name
        if name in domains:
            raise ConfigError(
                f"{configs[0].name} and {domains[name].configs[0].name} have different data "
                f"sections, but would both be of the domain {name!r}: rename one"
            )
        domains[name] = Domain(name, tuple(configs))
    return list(domains.values())
