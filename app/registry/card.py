"""The model card: five sentences, purpose, metrics, data, terms and limits of a model.

Sections follow Mitchell et al., "Model Cards for Model Reporting", FAT* 2019.
"""

from collections.abc import Iterable, Mapping, Sequence
from math import prod

from app.inference import MachineSpec
from app.model.statistics import Counts, Offsets
from app.registry.description import DataSource, Description
from app.registry.manifest import TensorEntry, of_machine
from app.registry.summary import summary

_INTENDED_USE = """\
A robot recognises the objects of a scene and asks the model about them. The scene should resemble
the scenes of the data sources below. The model answers questions about a scene: Which spatial
relations hold between the objects? Which object is missing, and where would it be? Which object
does not belong? Which room is it? What does a similar scene look like? Where in a home is a
thing?"""

_MEASURED = """\
The figures come from test scenes of each source. Training and calibration did not use these scenes.
Brackets contain 95 % confidence intervals. The manifest has the number of answers behind each
figure."""

_FINAL_FIT = """\
The figures below measure a first training run without the test scenes. The published weights come
from a second training run with the same configuration on nine tenths of all scenes. The calibration
of the second run used the other tenth."""

_ADAPTED = """\
The figures below compare the model with its parent, in five folds of the recorded scenes: scenes
that the adapted weights had not seen."""

_PROBABILITIES = """\
The probabilities are calibrated on validation scenes, and those of objects on random parts of the
scenes. Perfect probabilities have an expected calibration error (ECE) of 0 and a Brier skill of 1.
A Brier skill of 0 means that the base rate is equally good. The probabilities mean:

- relations: the relation holds between the two objects
- placements: the relation holds between the missing object and an object of the scene
- missing: the class is in the scene although it was not listed; in answers about a place: the class
  is in the scene and at this place
- outliers: the object is an intruder, if half of the lists contain an intruder; at the default
  threshold, about 10 % of the unchanged parts of real validation scenes raise an alarm
- misplaced: the relation is false, if half of the scenes contain an altered relation
- rooms: the scene is a room of this type"""

_OFFSETS = """\
The rows "Offsets" measure the offsets of placements by relation. Mean and standard deviations
predict an ellipse (in the plane) or an ellipsoid for 80 % of the objects. Coverage is the share of
objects inside it. The distance is the distance of an object from the mean. It is compared with the
distance from a mean that depends on the relation alone."""

_LIMITS = """\
- The model scores classes, not instances. The number of instances comes from separate statistics of
  the training scenes. It is unknown for classes without such statistics.
- Annotators list only a few relations of each scene. An unlisted relation counts as wrong in
  R-precision although it may be true.
- Left and front refer to the viewer's axes. If a source has no viewer, training chose one. Both
  relations depend on this choice.
- Offsets predict where an object usually is. They ignore free space, and the size and heading of
  the other object.
- The model does not know labels outside its vocabulary. It accepts structural and vague labels
  (floor, sky, object), but never proposes them. They change no answer about objects.
- The figures do not apply if a scene differs from the scenes of the sources above.
- A probability is a statistical statement about such scenes, not a safety check. Do not let a
  robot move an object, or leave it in place, because of this answer alone."""


def render_card(description: Description, tensors: Mapping[str, TensorEntry]) -> str:
    """Return the model card in Markdown."""
    words = description.vocabulary
    proposed = sum(not entry.structure for entry in words.objects)
    machine = of_machine(tensors)
    weights = sum(prod(e.shape) for e in machine.values() if e.dtype.startswith("float"))
    stored = ", ".join(sorted({entry.dtype for entry in machine.values()}))
    pairs, counted = (
        prod(tensors[name].shape) if name in tensors else 0
        for name in (f"{Offsets.prefix}pair", f"{Counts.prefix}classes")
    )
    sections = [
        f"# {description.name} {description.version}",
        "\n".join(f"- {_cell(sentence)}" for sentence in summary(description)),
        "## Model",
        _table(
            ("", ""),
            [
                ("Kind", f"{description.variant}, a Boltzmann machine over objects and relations"),
                *_machine(MachineSpec.from_dict(dict(description.spec))),
                ("Profiles", ", ".join(words.profiles) or "none"),
                ("Weights", f"{weights:,} (stored as {stored})"),
                ("Object classes", f"{len(words.objects)}, of which {proposed} may be proposed"),
                ("Relations", ", ".join(words.relations)),
                ("Room types", ", ".join(words.room_types) or "none"),
                ("Offsets", f"in metres, of {pairs:,} pairs of classes" if pairs else "none"),
                ("Counts", f"of instances, for {counted} classes" if counted else "none"),
                ("Created", description.created.isoformat()),
            ],
        ),
        "## Intended use",
        _INTENDED_USE,
        "## Metrics",
        *([_FINAL_FIT] if "measured_split" in description.training else []),
        *([_ADAPTED] if "parent" in description.training else []),
        _metrics(description),
        "## Data and terms",
        *_shares(description.data),
        _table(
            ("Source", "Scenes", "Share", "Terms", "SHA-256"),
            [
                (s.source, f"{s.scenes:,}", _share(s.share), s.terms, f"`{s.digest[:16]}…`")
                for s in description.data
            ],
        ),
        f"Terms of the weights: {description.terms}",
        "## Limits",
        _LIMITS,
        "## Made with",
        ", ".join(f"{name} {version}" for name, version in description.libraries.items())
        or "not recorded",
    ]
    return "\n\n".join(sections) + "\n"


def _shares(data: Sequence[DataSource]) -> list[str]:
    """Return a sentence about the shares of written and of seen scenes, if they are recorded."""
    shares = [(source.written, source.share) for source in data]
    if not shares or any(share is None for _, share in shares):
        return []
    written = sum(share or 0.0 for is_written, share in shares if is_written)
    return [
        f"Scenes drawn from written places have {_share(written)} of the weight of all scenes that "
        f"teach objects, and seen scenes have {_share(1 - written)}. Shares by source:"
    ]


def _share(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def _machine(spec: MachineSpec) -> list[tuple[str, str]]:
    """Return the rows of the table about units and weights."""
    relations = f"own weights of {spec.T:,} triples"
    if spec.kind.factorised:
        relations = f"factors of rank {spec.K}, and {relations}"
    if spec.G:
        relations += f"; implications of rank {spec.G}"
    kinds = "binary units" if spec.states == 2 else f"units of {spec.states} states"
    return [
        ("Hidden units", f"{spec.units} {kinds}"),
        ("Couplings", "between all pairs of classes" if spec.coupled else "none"),
        ("Relation weights", relations),
        ("Stored scenes", f"{spec.N:,}, where chains start" if spec.N else "none"),
    ]


def _metrics(description: Description) -> str:
    """Return the section about metrics: a table of tasks by data sources, and its notes."""
    if not description.metrics:
        return "No metrics are recorded, so the quality of the answers is unknown."
    sources = list(dict.fromkeys(entry.source for entry in description.metrics))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for entry in description.metrics:
        cells = rows.setdefault((entry.task, entry.metric), dict.fromkeys(sources, ""))
        cells[entry.source] = f"{entry.value:.3f} [{entry.low:.3f}, {entry.high:.3f}]"
    table = [(*name, *row.values()) for name, row in rows.items()]
    note = [_OFFSETS] if any(entry.task == "Offsets" for entry in description.metrics) else []
    parts = [_MEASURED, _table(("Task", "Metric", *sources), table), _PROBABILITIES]
    return "\n\n".join([*parts, *note])


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(text: str) -> str:
    """Escape text for a table cell."""
    return " ".join(text.replace("|", "\\|").split())
