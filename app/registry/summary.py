"""Five plain sentences about a model: its data, its knowledge, its alarms, their limits, its use.

They start the model card and the output of `python -m training compare`. Each figure comes from the
description of the model.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from app.model.calibration import RARELY, Calibration
from app.registry.description import DataSource, Description, Metric
from app.scene.vocabulary import Vocabulary

_NAMED: Final = 5  # room types, classes or sources in a sentence
_ALARMS: Final = re.compile(r"alarms, medium, (\d+) classes")
_HOME_ALARMS: Final = "scenes with an alarm, "


class AlarmShare(NamedTuple):
    """Lists of test scenes without an intruder, where each alarm is wrong."""

    alarms: float
    lists: int

    def __str__(self) -> str:
        return percent(self.alarms / self.lists)


def summary(description: Description) -> list[str]:
    """Return the five sentences of a model."""
    words, training = description.vocabulary.vocabulary(), description.training
    parent = training.get("parent")
    if isinstance(parent, dict):
        origin = _of_home(training, "@".join((str(parent["name"]), str(parent["version"]))))
        alarms = home_alarms(description.metrics)
    else:
        config: Any = training.get("config")
        origin = trained_on("The model", description.data, _drawn_of_place(config))
        alarms = wrong_alarms(description.metrics)
    return [
        origin,
        knows("The model", words, description.calibration),
        alarms,
        judges_not("The model", words, description.calibration),
        use(description.data, description.terms),
    ]


def _drawn_of_place(config: Any) -> int:
    """Return the number of scenes drawn of each written place, or 0 if it is not recorded."""
    data = config.get("data") if isinstance(config, Mapping) else None
    drawn = data.get("written") if isinstance(data, Mapping) else None
    return drawn if isinstance(drawn, int) else 0


def _of_home(training: Mapping[str, Any], parent: str) -> str:
    """Return the sentence about the data of a model that was adapted to a home."""
    numbers = [
        _number(training[name], what)
        for name, what in (("recorded", "recorded scene"), ("written", "written place"))
        if training.get(name)
    ]
    own = f" with {' and '.join(numbers)} of this home" if numbers else ""
    return f"The model was adapted to one home from {parent}{own}."


def trained_on(subject: str, data: Sequence[DataSource], drawn: int) -> str:
    """Return the sentence about training data; training drew `drawn` scenes of a written place."""
    if not data:
        return f"The training data of {subject[0].lower()}{subject[1:]} is not recorded."
    scenes = sum(source.scenes for source in data)
    written = sum(source.scenes for source in data if source.written)
    sentence = f"{subject} learnt from {_number(scenes, 'scene')} of "
    sentence += _number(len(data), "source")
    if len(data) <= _NAMED:
        sentence += f" ({', '.join(source.source for source in data)})"
    if not written:
        return f"{sentence}, all seen."
    places = f"{_number(written // drawn, 'written place')}" if drawn else "written places"
    number = "all" if written == scenes else f"{written:,}"
    rest = "" if written == scenes else ", the others seen"
    return f"{sentence}, {number} drawn from {places}{rest}."


def knows(subject: str, words: Vocabulary, calibration: Calibration) -> str:
    """Return the sentence about classes and room types."""
    things, rooms = int((~words.structure).sum()), words.room_types
    sentence = f"{subject} knows {_number(things, 'kind')} of things and "
    if not rooms:
        return f"{sentence}no type of room."
    sentence += f"{_number(len(rooms), 'type')} of rooms, such as {_some(rooms)}"
    if 0 < (written := len(calibration.written_rooms)) < len(rooms):
        sentence += f"; {written:,} of these types come from written descriptions alone"
    return f"{sentence}."


def shares_of_alarms(metrics: Iterable[Metric]) -> dict[str, AlarmShare]:
    """Return the alarms in unchanged lists of test scenes at the default sensitivity, by source.

    The lists have at least two classes, because the model judges no single class.
    """
    totals: defaultdict[str, list[float]] = defaultdict(lambda: [0.0, 0])
    for entry in _of_lists(metrics):
        totals[entry.source][0] += entry.value * entry.n
        totals[entry.source][1] += entry.n
    return {source: AlarmShare(alarms, int(n)) for source, (alarms, n) in totals.items()}


def lengths_of_lists(metrics: Iterable[Metric]) -> str:
    """Return the numbers of classes of the lists as text, such as "2 to 8"."""
    lengths = sorted({_length(entry) for entry in _of_lists(metrics)})
    return str(lengths[0]) if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]}"


def _of_lists(metrics: Iterable[Metric]) -> list[Metric]:
    return [entry for entry in metrics if _length(entry) > 1]


def _length(metric: Metric) -> int:
    match = _ALARMS.fullmatch(metric.metric)
    return int(match[1]) if match else 0


def wrong_alarms(metrics: Sequence[Metric]) -> str:
    """Return the sentence about wrong alarms in test scenes."""
    shares = shares_of_alarms(metrics)
    if not shares:
        return "How often the model raises a wrong alarm is unknown."
    together = AlarmShare(*map(sum, zip(*shares.values(), strict=True)))
    sentence = (
        f"With the default sensitivity, the model raises a wrong alarm in {together} of "
        f"{together.lists:,} lists of {lengths_of_lists(metrics)} things from unchanged test scenes"
    )
    if len(shares) == 1:
        return f"{sentence}."
    worst = max(shares, key=lambda source: shares[source].alarms / shares[source].lists)
    return f"{sentence}; the highest share of a source is {shares[worst]} ({worst})."


def home_alarms(metrics: Sequence[Metric]) -> str:
    """Return the sentence about alarms in the recorded scenes of a home."""
    of = {entry.metric: entry for entry in metrics}
    adapted, parent = (of.get(f"{_HOME_ALARMS}{side}") for side in ("adapted", "parent"))
    if adapted is None or parent is None:
        return "How often the model raises a wrong alarm in this home is unknown."
    return (
        f"With the default sensitivity, the model raises an alarm, right or wrong, in "
        f"{percent(adapted.value)} of {_number(adapted.n, 'recorded scene')} that the fit did not "
        f"see, and its parent in {percent(parent.value)}."
    )


def judges_not(subject: str, words: Vocabulary, calibration: Calibration) -> str:
    """Return the sentence about objects and relations without an alarm."""
    relations = "" if calibration.misplaced.judges_relations else " and no relation"
    if calibration.outlier is None:
        return f"{subject} judges no object{relations}: its calibration had too few scenes."
    never = []
    if anywhere := [entry.label for entry in words.objects if entry.anywhere]:
        never.append(f"kinds that belong anywhere ({len(anywhere)}, such as {_some(anywhere)})")
    if rare := int((calibration.rarely_shown(len(words)) & words.judged).sum()):
        scenes = round(1 / RARELY)
        never.append(f"kinds that fewer than 1 of {scenes} training scenes show ({rare:,})")
    never.append("words outside its vocabulary")
    more = f"; it judges{relations[4:]}" if relations else ""
    return f"{subject} raises no alarm about {_joined(never)}{more}."


def use(data: Sequence[DataSource], terms: str) -> str:
    """Return the sentence about permitted use."""
    bound = [source.source for source in data if source.research_only]
    if not bound:
        return f"A commercial robot may use the weights under their terms: {terms.rstrip('.')}."
    return (
        "Use the weights for research only, because the terms of "
        f"{', '.join(bound)} exclude commercial robots."
    )


def percent(share: float) -> str:
    """Return a share as text."""
    return f"{100 * share:.1f} %"


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def _some(names: Sequence[str]) -> str:
    """Return a few of the names, from the whole list."""
    chosen = np.linspace(0, len(names) - 1, min(_NAMED, len(names))).round().astype(int).tolist()
    return _joined([names[index] for index in chosen])


def _joined(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
