"""The model card: what a person should know before a robot acts on this model's answers.

Sections follow Mitchell et al., "Model Cards for Model Reporting", FAT* 2019.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import prod

from app.registry.description import DataSource, Description
from app.registry.manifest import TensorEntry
from app.registry.offsets import PREFIX

_RESEARCH_WARNING = """\
> **Research use.** These weights were learned from {sources}, whose terms allow research use. Do
> not ship them in a commercial robot without asking the owners of the data; a model trained on
> freely licensed scenes alone carries no such warning."""

_INTENDED_USE = """\
For a robot that has recognised the objects of a scene like those of the sources below: which
spatial relations hold between them, which object is missing and where it would stand, which one
does not belong, and what such a scene looks like."""

_MEASURED = """\
On test scenes of each source, which neither training nor calibration has seen; 95 % intervals in
brackets. How many answers each figure is made of is in the manifest."""

_FINAL_FIT = """\
The figures are those of a first fit, which kept the test scenes back. The weights here are of a
second fit of the same configuration: to all scenes but a tenth, on which it was calibrated."""

_PROBABILITIES = """\
Calibrated on validation scenes to this, ECE 0 and Brier skill 1 being perfect (0: no better than
how often such answers are true):

- relations: the relation holds between the two objects; placements: it holds between a missing
  object and one that is there
- missing: the class is there although it was not listed; at a place: and stands there
- outliers: the object is an intruder, where half of the scenes are clean; at the default threshold
  about 10 % of untouched scenes of the hardest large source raise an alarm
- misplaced: the relation is false, where one was altered in half of the scenes"""

_OFFSETS = """\
Of the offsets of placements: the share of things that stood inside the ellipse (in the plane) or
the ellipsoid that mean and standard deviations draw for 80 %, by relation; and how far they stood
from the mean, beside what the relation alone would have said."""

_LIMITS = """\
- The model speaks of classes, not of instances: it says whether a class belongs here, not how many
  of it. How many chairs a table wants is outside it.
- Annotators list a few relations of each scene. An unlisted relation counts as wrong in R-precision
  without being false.
- Left and front are meant in the viewer's axes. Where a source has no viewer, one was chosen in
  training, and these two relations carry that choice.
- Offsets say where such a thing usually stands, not where there is room for it; they know neither
  the size nor the heading of what it stands at.
- Labels outside the vocabulary are not understood. Structure and vague labels (floor, sky, object)
  are accepted and never proposed.
- Scenes unlike those of the sources above are outside what the figures speak of, and so are scenes
  of which the robot saw a small part.
- A probability is a statistical statement about such scenes. It is no safety check: do not let a
  robot move something, or leave it alone, on this answer only."""


def render_card(description: Description, tensors: Mapping[str, TensorEntry]) -> str:
    """The card of a model, Markdown."""
    words, spec = description.vocabulary, description.spec
    proposed = sum(not entry.structure for entry in words.objects)
    machine = {name: e for name, e in tensors.items() if not name.startswith(PREFIX)}
    weights = sum(prod(e.shape) for e in machine.values() if e.dtype.startswith("float"))
    stored = ", ".join(sorted({entry.dtype for entry in machine.values()}))
    pairs = prod(tensors[f"{PREFIX}pair"].shape) if f"{PREFIX}pair" in tensors else 0
    sections = [
        f"# {description.name} {description.version}",
        *_warning(description.data),
        "## Model",
        _table(
            ("", ""),
            [
                ("Kind", f"{description.variant}, a Boltzmann machine over objects and relations"),
                ("Shape", ", ".join(f"{name} {value}" for name, value in spec.items())),
                ("Weights", f"{weights:,} (stored as {stored})"),
                ("Object classes", f"{len(words.objects)}, of which {proposed} may be proposed"),
                ("Relations", ", ".join(words.relations)),
                ("Room types", ", ".join(words.room_types) or "none"),
                ("Offsets", f"in metres, of {pairs:,} pairs of classes" if pairs else "none"),
                ("Created", description.created.isoformat()),
            ],
        ),
        "## Intended use",
        _INTENDED_USE,
        "## Metrics",
        *([_FINAL_FIT] if "measured_split" in description.training else []),
        _metrics(description),
        "## Data and terms",
        _table(
            ("Source", "Scenes", "Terms", "SHA-256"),
            [(s.source, f"{s.scenes:,}", s.terms, f"`{s.digest[:16]}…`") for s in description.data],
        ),
        f"Terms of the weights: {description.terms}",
        "## Limits",
        _LIMITS,
        "## Made with",
        ", ".join(f"{name} {version}" for name, version in description.libraries.items())
        or "not recorded",
    ]
    return "\n\n".join(sections) + "\n"


def _warning(data: Sequence[DataSource]) -> Iterable[str]:
    if sources := [source.source for source in data if source.research_only]:
        yield _RESEARCH_WARNING.format(sources=", ".join(map(_cell, sources)))


def _metrics(description: Description) -> str:
    if not description.metrics:
        return "None recorded: nothing is known of how well this model answers."
    sources = list(dict.fromkeys(m.source for m in description.metrics))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for m in description.metrics:
        cell = f"{m.value:.3f} [{m.low:.3f}, {m.high:.3f}]"
        rows.setdefault((m.task, m.metric), {})[m.source] = cell
    table = _table(
        ("Task", "Metric", *sources),
        [(*name, *(cells.get(source, "") for source in sources)) for name, cells in rows.items()],
    )
    where = f"\n\n{_OFFSETS}" if any(m.task == "Offsets" for m in description.metrics) else ""
    return f"{_MEASURED}\n\n{table}\n\n{_PROBABILITIES}{where}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(text: str) -> str:
    """Text that cannot break out of its cell."""
    return " ".join(text.replace("|", "\\|").split())
