"""`python -m training homes`: adapt a model to houses that its training never saw.

Each house of `matterport_rooms` with ten or more rooms is a home. The model, the parent of the
homes, never saw these houses. A robot visits 70 % of the rooms of a home. Each visit
sees a random part of a room, 40 to 100 % of its classes. A person confirms the scenes in which the
parent raises an alarm, because all alarms are false. The command measures, for parent and home:

- the share of later visits with an alarm,
- the MRR of a class that a later visit does not list,
- the share of visits to the other rooms with an alarm,
- the share of alarms about an intruder that was recorded twice without a confirmation.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer

from app.model import SceneModel
from app.registry import DEFAULT_STORE, Store
from training.datasets import EncodedScene, encode
from training.datasets.array_types import Ints, Rng
from training.datasets.files import DATA, write_whole
from training.domain.adaptation import adapted
from training.domain.home import Home, HomeScene, alarms_of, of_classes
from training.domain.init_command import StorePath
from training.evaluation.parts import ALL_BUT_ONE
from training.fit.adapt import adapt
from training.fit.configuration import ConfigError, DataConfig
from training.machines.arrays import machine_of
from training.research.benchmark import Data, Workers, console
from training.research.measure import resumable
from training.runs.pipeline import read_sources

_SOURCE = "matterport_rooms"
_ROOMS = 10  # minimum number of rooms of a home
_VISITED = 0.7
_LEAST_SHARE = 0.4
_LATER, _OTHER = 60, 6  # later visits of a home; visits of each other room
_INTRUDERS, _LOOKS = 2, 15  # intruders of a home, and later visits with each of them


@dataclass(frozen=True)
class Row:
    """The figures of one home; pairs are (parent, home)."""

    home: str
    scenes: int
    alarms: tuple[float, float]
    mrr: tuple[float, float]
    other_rooms: tuple[float, float]
    intruder: tuple[float, float] | None  # None: the parent reports too few intruders
    refused: bool


def homes(
    model: Annotated[str, typer.Argument(help="NAME or NAME@VERSION in the store")] = "default",
    scenes: Annotated[list[int] | None, typer.Option(help="recorded scenes of a home")] = None,
    data: Data = None,
    store: StorePath = DEFAULT_STORE,
    folder: Annotated[Path, typer.Option("--folder", help="folder for the results")] = Path(
        "runs/homes"
    ),
    workers: Workers = 2,
) -> None:
    """Measure `adapt` on houses that the training of the model never saw.

    The command writes results.json into the folder.
    """
    with resumable(console):
        models = Store(store)
        artifact = models.load(*models.resolve(model))
        if _SOURCE in (one.source for one in artifact.manifest.data):
            raise ConfigError(f"{artifact.key} has learnt from the houses of {_SOURCE}")
        parent = artifact.model
        houses = _houses(parent, data or DATA)
        measure = partial(_measure_house, parent, scenes or [20])
        with ProcessPoolExecutor(workers) as pool:
            rows = [row for part in pool.map(measure, *zip(*houses, strict=True)) for row in part]
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "results.json", json.dumps([asdict(row) for row in rows], indent=1))
        for line in summary(rows):
            console.print(line, highlight=False)


def summary(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the means over homes, for each number of recorded scenes."""
    for count in sorted({row.scenes for row in rows}):
        part = [row for row in rows if row.scenes == count]
        worse = sum(row.alarms[1] > row.alarms[0] or row.mrr[1] < row.mrr[0] for row in part)
        yield (
            f"{count} scenes, {len(part)} homes; refused: {sum(row.refused for row in part)}, "
            f"worse: {worse}"
        )
        for name in ("alarms", "mrr", "other_rooms", "intruder"):
            if pairs := [pair for row in part if (pair := getattr(row, name)) is not None]:
                before, after = np.mean(pairs, axis=0)
                yield f"  {name:12} {before:.3f} → {after:.3f}"


def _houses(parent: SceneModel, root: Path) -> list[tuple[str, list[EncodedScene]]]:
    """Return each house with at least `_ROOMS` rooms, and its rooms in classes of the parent."""
    rooms: dict[str, list[EncodedScene]] = {}
    annotated = read_sources(DataConfig(sources=(_SOURCE,)), root)[_SOURCE]
    for scene in encode(annotated, parent.vocabulary):
        rooms.setdefault(scene.group, []).append(scene)
    return sorted((name, own) for name, own in rooms.items() if len(own) >= _ROOMS)


def _measure_house(
    parent: SceneModel, counts: Sequence[int], name: str, rooms: Sequence[EncodedScene]
) -> list[Row]:
    torch.set_num_threads(1)
    return [_measure(parent, name, rooms, count) for count in counts]


def _measure(parent: SceneModel, name: str, rooms: Sequence[EncodedScene], count: int) -> Row:
    structure = parent.vocabulary.structure
    rng = np.random.default_rng([zlib.crc32(name.encode()), count])
    classes = [(s.evidence.classes[~structure[s.evidence.classes]], s.room_type) for s in rooms]
    classes = [entry for entry in classes if len(entry[0]) >= 3]
    order = rng.permutation(len(classes))
    visited = [classes[k] for k in order[: max(1, round(_VISITED * len(order)))]]
    others = [classes[k][0] for k in order[len(visited) :]]

    def visit() -> tuple[Ints, Ints, int]:
        room, kind = visited[rng.integers(len(visited))]
        return _part(room, rng), room, kind

    recorded = [visit() for _ in range(count)]
    later = [visit() for _ in range(_LATER)]
    hidden = [(part, int(rng.choice(part)), room) for part, room, _ in later]
    seen_elsewhere = [_part(room, rng) for room in others for _ in range(_OTHER)]
    home = _home(parent, [(part, kind) for part, _, kind in recorded])
    result = adapted(home)
    sides = parent, result.model or parent
    lists = [part for part, *_ in later]
    return Row(
        home=name,
        scenes=count,
        alarms=_pair(sides, partial(_alarm_share, lists=lists)),
        mrr=_pair(sides, partial(_mrr, visits=hidden)),
        other_rooms=_pair(sides, partial(_alarm_share, lists=seen_elsewhere)),
        intruder=_intruder(home, lists, np.unique(np.concatenate([c for c, _ in classes])), rng),
        refused=bool(result.objections),
    )


def _part(room: Ints, rng: Rng) -> Ints:
    """Return a random part of the classes of a room, ascending."""
    count = max(2, round(len(room) * rng.uniform(_LEAST_SHARE, 1)))
    return np.sort(rng.permutation(room)[:count])


def _home(
    parent: SceneModel, visits: Sequence[tuple[Ints, int]], unconfirmed: Sequence[Ints] = ()
) -> Home:
    """Return the recordings. A person has confirmed the visits that raise an alarm."""
    scenes = []
    for number, (classes, room) in enumerate([*visits, *((part, -1) for part in unconfirmed)]):
        kind = None if room < 0 else room
        alarms = alarms_of(parent, of_classes(parent, classes, kind))
        confirmed = number < len(visits) and len(alarms) > 0
        left_out = alarms[:0] if confirmed else alarms
        scenes.append(HomeScene(classes, left_out, kind, f"visit-{number}", confirmed))
    return Home(parent, (parent.spec.V, parent.spec.C), tuple(scenes), len(scenes))


Sides = tuple[SceneModel, SceneModel]


def _pair(sides: Sides, figure: Callable[[SceneModel], float]) -> tuple[float, float]:
    return figure(sides[0]), figure(sides[1])


def _alarm_share(side: SceneModel, lists: Sequence[Ints], about: int | None = None) -> float:
    """Return the share of lists with an alarm, or with an alarm about a class."""
    alarms = [alarms_of(side, of_classes(side, part, None)) for part in lists]
    return float(np.mean([len(one) > 0 if about is None else about in one for one in alarms]))


@torch.no_grad()
def _mrr(side: SceneModel, visits: Sequence[tuple[Ints, int, Ints]]) -> float:
    """Return the MRR of the hidden class of visits (part, hidden class, classes of the room)."""
    machine, structure = (
        machine_of(side.weights),
        torch.from_numpy(side.vocabulary.structure.copy()),
    )
    ranks = []
    for part, hidden, room in visits:
        listed = torch.zeros(1, side.spec.V)
        listed[0, np.setdiff1d(part, [hidden])] = 1
        log_odds = machine.object_log_odds(listed, share=torch.tensor([ALL_BUT_ONE]))[0]
        # Other classes of the room are no errors.
        log_odds[np.setdiff1d(room, [hidden])] = log_odds[structure] = -torch.inf
        ranks.append(1 / (1 + int((log_odds > log_odds[hidden]).sum())))
    return float(np.mean(ranks))


def _intruder(home: Home, lists: Sequence[Ints], own: Ints, rng: Rng) -> tuple[float, float] | None:
    """Return the mean alarms about intruders that were recorded twice, without a confirmation."""
    parent = home.parent
    visits = [(scene.classes, -1 if scene.room is None else scene.room) for scene in home.scenes]
    shares: list[tuple[float, float]] = []
    for intruder in rng.permutation(np.setdiff1d(np.flatnonzero(parent.vocabulary.judged), own)):
        seen = [np.union1d(part, [intruder]) for part in lists[:_LOOKS]]
        if before := _alarm_share(parent, seen, intruder):
            twice = [np.union1d(part, [intruder]) for part in lists[-2:]]
            recorded = _home(parent, visits, twice)
            weights = adapt(parent.weights, recorded.tensors, known=recorded.learnt)
            after = _alarm_share(replace(parent, weights=weights), seen, intruder)
            shares.append((before, after))
        if len(shares) == _INTRUDERS:
            break
    else:
        return None
    first, second = np.mean(shares, axis=0).tolist()
    return first, second
