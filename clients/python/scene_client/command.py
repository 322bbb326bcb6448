"""The command ``scene``. It sends questions to the service from the command line.

The command writes errors to standard error. The help text of `app` lists the exit statuses.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn, TypeVar

import typer
from pydantic import BaseModel
from rich.console import Console, RenderableType
from typer.core import TyperGroup

from scene_client import __version__, mcp_server, phrases, planner, tables
from scene_client.errors import (
    ClientError,
    DeadlineError,
    HomeFileError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
)
from scene_client.files import from_file, is_file, label_map_of, rooms_from_file
from scene_client.formats import from_data
from scene_client.frames import CONVENTIONS, BoxOrigin, Extents, QuaternionOrder, Units, Up
from scene_client.offline import OfflineClient
from scene_client.ros_fields import MessageError
from scene_client.schemas import Detail, Sensitivity, UnknownLabels
from scene_client.sync import Client
from scene_client.untrusted import (
    printable,
    printable_answer,
    printable_json,
    printable_lines,
)

REFUSED, MEANINGLESS, UNREACHABLE, LATE, BUSY, FAILED = range(1, 7)

_FLAGS: Final = ("--json",)
_VALUED: Final = (
    *("--url", "--model", "--offline", "--timeout", "--record"),
    *(f"--{name.replace('_', '-')}" for name in CONVENTIONS),
)
_MAX_NOTES: Final = 10  # maximum number of printed notes on a file


class _Group(TyperGroup):
    """A group of commands whose general options may also follow the subcommand."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Move the general options before the subcommand, then parse all arguments."""
        general_options, other_words = [], []
        words = iter(args)
        for word in words:
            if word == "--":  # all later words are arguments of the subcommand
                other_words += [word, *words]
            elif word in _VALUED:  # the next word is the value
                general_options += [word, *islice(words, 1)]
            elif word in _FLAGS or word.partition("=")[0] in _VALUED:
                general_options.append(word)
            else:
                other_words.append(word)
        parsed: list[str] = super().parse_args(ctx, general_options + other_words)
        return parsed


AnswerT = TypeVar("AnswerT", bound=BaseModel)

app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Ask which objects are missing from a scene, which do not belong, how they relate, and "
    "which room it is. Or ask where in a home a thing is.",
    epilog="The options above may also follow the subcommand. Exit status: 1 request refused, "
    "2 wrong usage, 3 service not reached, 4 answer too late, 5 service busy or not ready, "
    "6 other error.",
)


@dataclass(frozen=True)
class Options:
    """The general options, which apply to every question."""

    url: str
    model: str | None
    store: Path | None
    timeout: float
    as_json: bool
    record: Path | None
    conventions: dict[str, str]

    def client(self, api_key: str | None = None) -> Client:
        """Return the client that sends the question."""
        if self.store is not None:
            return OfflineClient(
                self.store, timeout=self.timeout, model=self.model, record=self.record
            )
        return Client(
            self.url, timeout=self.timeout, model=self.model, api_key=api_key, record=self.record
        )


def _api_key() -> str | None:
    # An environment variable sets the API key, because other users of the machine can read the
    # options of a process.
    return os.environ.get("SCENE_API_KEY") or None


def _show(
    context: typer.Context,
    question: Callable[[Client], AnswerT],
    table: Callable[[AnswerT], RenderableType],
) -> None:
    """Print the answer to a question as JSON or as a table. An error ends the program."""
    options: Options = context.obj
    with _exit_on_error(), options.client(_api_key()) as client:
        answer = question(client)
    if options.as_json:
        print(printable_json(answer.model_dump_json(exclude_unset=True)))
        return
    answer = printable_answer(answer)
    console = Console(markup=False, highlight=False, emoji=False)
    if not console.is_terminal:
        # The output goes to a file or a program, so rich must not cut or wrap the table.
        console.width = 10_000
    console.print(table(answer))
    for note in tables.notes(answer):
        print(note, file=sys.stderr)


def _version(is_set: bool) -> None:
    if is_set:
        print(f"scene {__version__}")
        raise typer.Exit


@app.callback()
def main(
    context: typer.Context,
    url: Annotated[
        str, typer.Option(envvar="SCENE_URL", help="Address of the service.")
    ] = "http://127.0.0.1:8000",
    model: Annotated[
        str | None,
        typer.Option(
            help="Model to ask: an alias, a name, or name@version.", show_default="default"
        ),
    ] = None,
    offline: Annotated[
        Path | None,
        typer.Option(metavar="STORE", help="Answer from this model store, without a service."),
    ] = None,
    timeout: Annotated[
        float, typer.Option(help="Maximum time of the whole call in seconds.")
    ] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENES.jsonl", help="Append the scene to this file, in the training format."
        ),
    ] = None,
    up: Annotated[
        Up | None, typer.Option(help="Axis of the frame that points up.", show_default="z")
    ] = None,
    units: Annotated[Units | None, typer.Option(help="Unit of lengths.", show_default="m")] = None,
    extents: Annotated[
        Extents | None,
        typer.Option(help="Sizes are whole sides or half of each.", show_default="full"),
    ] = None,
    box_origin: Annotated[
        BoxOrigin | None,
        typer.Option(help="The point of a box at its position.", show_default="centre"),
    ] = None,
    quaternion_order: Annotated[
        QuaternionOrder | None, typer.Option(help="Order of quaternions.", show_default="xyzw")
    ] = None,
    version: Annotated[  # noqa: ARG001 — the callback prints the version
        bool,
        typer.Option("--version", help="Print the version.", callback=_version, is_eager=True),
    ] = False,
) -> None:
    """Store the general options for the subcommand."""
    conventions = _named(
        up=up, units=units, extents=extents, box_origin=box_origin,
        quaternion_order=quaternion_order,
    )  # fmt: skip
    context.obj = Options(url, model, offline, timeout, as_json, record, conventions)


# ---------------------------------------------------------------------------------- questions

Things = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="LABEL... | FILE | FILE:SCENE | -",
        help="Labels of the objects (spaces or commas between them), or a file, or - for standard "
        "input: a request, a training scene, or detections (ROS, COCO, YOLO, Ultralytics, CSV and "
        "others). SCENE is the line, the image or the room in a file with several.",
        show_default=False,
    ),
]
Stated = Annotated[
    list[str] | None,
    typer.Option(
        "--relations", help='A relation that holds, such as "lamp on-top desk"; repeatable.'
    ),
]
RoomType = Annotated[str | None, typer.Option(help="Type of the room.")]
TopK = Annotated[int | None, typer.Option(help="Maximum number of results.")]
Unknown = Annotated[
    UnknownLabels | None,
    typer.Option(
        help="Unknown labels: refuse them, ignore them, map them to the nearest class, or read "
        "them by their meaning."
    ),
]
LabelMap = Annotated[
    str | None,
    typer.Option(
        metavar="coco80|coco91|FILE",
        help="Labels of numeric class ids: COCO's ids 0 to 79, COCO's ids 1 to 90, or a file with "
        "one label a line, a JSON list, a JSON object from ids to labels, COCO's categories, or "
        "the YAML of a YOLO data set.",
    ),
]
HowMuch = Annotated[
    Detail | None, typer.Option(help="Only the scores, or also places and reasons.")
]


@app.command()
def relations(
    context: typer.Context,
    things: Things = None,
    relations: Stated = None,
    room_type: RoomType = None,
    top_k: TopK = None,
    min_probability: Annotated[
        float | None, typer.Option(help="Leave out relations with a lower probability.")
    ] = None,
    include_opposites: Annotated[
        bool,
        typer.Option(
            "--include-opposites", help="Also list right, behind, under, below and contains."
        ),
    ] = False,
    unknown_labels: Unknown = None,
    label_map: LabelMap = None,
) -> None:
    """List the likely spatial relations between the objects."""
    scene = _scene(
        context, things, label_map, relations, room_type=room_type, unknown_labels=unknown_labels
    )
    request = scene | _named(
        top_k=top_k, min_probability=min_probability, include_opposites=include_opposites or None
    )
    _show(context, lambda client: client.relations(request), tables.relations)


@app.command()
def missing(
    context: typer.Context,
    things: Things = None,
    coverage: Annotated[
        float | None,
        typer.Option(help="Probability that an object of the scene is listed, 0 to 1."),
    ] = None,
    at: Annotated[
        str | None, typer.Option(help='Answer only about this place, such as "on-top desk".')
    ] = None,
    candidates: Annotated[
        list[str] | None, typer.Option(help="Consider only this class; repeatable.")
    ] = None,
    relations: Stated = None,
    room_type: RoomType = None,
    top_k: TopK = None,
    unknown_labels: Unknown = None,
    label_map: LabelMap = None,
    detail: HowMuch = None,
) -> None:
    """List objects that the scene probably lacks, and their likely places."""
    scene = _scene(
        context, things, label_map, relations, room_type=room_type, unknown_labels=unknown_labels
    )
    place = None if at is None else _read("--at", at, phrases.place)
    request = scene | _named(
        top_k=top_k, coverage=coverage, at=place, candidates=candidates or None, detail=detail
    )
    shown = partial(tables.missing, is_at_place=request.get("at") is not None)
    _show(context, lambda client: client.missing(request), shown)


@app.command()
def outliers(
    context: typer.Context,
    things: Things = None,
    sensitivity: Annotated[
        Sensitivity | None, typer.Option(help="Alarm rate: low, medium or high.")
    ] = None,
    threshold: Annotated[
        float | None, typer.Option(help="Minimum probability of an outlier.")
    ] = None,
    relations: Stated = None,
    room_type: RoomType = None,
    unknown_labels: Unknown = None,
    label_map: LabelMap = None,
    detail: HowMuch = None,
) -> None:
    """List objects that do not fit the scene, and relations that are probably false."""
    scene = _scene(
        context, things, label_map, relations, room_type=room_type, unknown_labels=unknown_labels
    )
    request = scene | _named(sensitivity=sensitivity, threshold=threshold, detail=detail)
    _show(context, lambda client: client.outliers(request), tables.outliers)


@app.command()
def rooms(
    context: typer.Context,
    things: Things = None,
    candidates: Annotated[
        list[str] | None, typer.Option(help="Consider only this room type; repeatable.")
    ] = None,
    top_k: TopK = None,
    unknown_labels: Unknown = None,
    label_map: LabelMap = None,
    detail: HowMuch = None,
) -> None:
    """List the likely types of the room, or where one object usually is."""
    scene = _scene(context, things, label_map, unknown_labels=unknown_labels)
    request = scene | _named(top_k=top_k, candidates=candidates or None, detail=detail)
    _show(context, lambda client: client.rooms(request), tables.rooms)


@app.command()
def generate(
    context: typer.Context,
    things: Things = None,
    count: Annotated[int | None, typer.Option(help="Number of scenes.")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed. Equal seeds give equal scenes.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Number of Gibbs sweeps.")] = None,
    temperature: Annotated[
        float | None,
        typer.Option(help="Sampling temperature, 0.05 to 1.5. High values give varied scenes."),
    ] = None,
    relations: Stated = None,
    room_type: RoomType = None,
    unknown_labels: Unknown = None,
    label_map: LabelMap = None,
) -> None:
    """Sample scenes that contain the given objects."""
    things = things or []
    scene = _scene(
        context, things, label_map, relations, room_type=room_type, unknown_labels=unknown_labels
    )
    request = scene | _named(count=count, seed=seed, steps=steps, temperature=temperature)
    _show(context, lambda client: client.generate(request), tables.generate)


@app.command()
def where(
    context: typer.Context,
    label: Annotated[str, typer.Argument(help="Label of the wanted thing.")],
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE | -",
            help="JSON file with the rooms of the home, or - for standard input: the file of a "
            'Home, a request, a list of rooms, or an object such as {"kitchen": ["fridge"]}.',
            show_default=False,
        ),
    ] = "",
    searched: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROOM[:OBJECT[:SHARE]]",
            help="Place where the robot has looked without success, such as bathroom:sink_1, and "
            "the share of it that the robot has seen; repeatable.",
        ),
    ] = None,
    top_k: TopK = None,
    unknown_labels: Unknown = None,
) -> None:
    """List the likely rooms and places of one thing in a home."""
    if not file:
        _fail("the rooms are missing: give a JSON file, or - for stdin")
    try:
        fields = rooms_from_file(file)
    except (MessageError, HomeFileError) as error:
        _fail(str(error))
    general: Options = context.obj
    places = [_read("--searched", text, phrases.search) for text in searched or ()]
    fields |= general.conventions | _named(top_k=top_k, unknown_labels=unknown_labels)
    if places:
        fields["searched"] = [*fields.get("searched", ()), *places]
    shown = partial(tables.where, rooms=fields["rooms"])
    _show(context, lambda client: client.where(label, **fields), shown)


# ------------------------------------------------------------------------------------- models


@app.command()
def models(context: typer.Context) -> None:
    """List the models of the service."""
    _show(context, Client.models, tables.models)


@app.command()
def vocabulary(context: typer.Context) -> None:
    """List the object classes and room types of the model."""
    _show(context, Client.vocabulary, tables.vocabulary)


@app.command()
def ready(context: typer.Context) -> None:
    """Check that the service is ready. The only output is the exit status."""
    options: Options = context.obj
    with _exit_on_error(), options.client(_api_key()) as client:
        client.check_ready()


# ------------------------------------------------------------------------------------ planners


@app.command(
    epilog="General options, before or after mcp: --url ADDRESS, --model NAME (default: the "
    "service's default), --offline STORE, --timeout SECONDS. See also scene --help."
)
def mcp(
    context: typer.Context,
    http: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            min=0,
            max=65535,
            help="Serve HTTP at http://127.0.0.1:PORT/mcp. The API key of each MCP request is "
            "passed on to the service.",
            show_default="stdio",
        ),
    ] = None,
    schemas: Annotated[
        planner.Vendor | None,
        typer.Option(help="Only print the tools as JSON, in the form of this vendor."),
    ] = None,
) -> None:
    """Serve tools for planners with a language model (Model Context Protocol)."""
    if schemas is not None:
        print(json.dumps(planner.schemas(schemas), indent=2))
        return
    options: Options = context.obj
    if options.conventions:
        _fail("the tools take positions in metres and sizes of boxes around their centre only")
    with _exit_on_error(), options.client(_api_key()) as client:
        if http is None:
            mcp_server.serve_stdio(lambda _: nullcontext(client))
        elif options.store is not None:
            mcp_server.serve_http(lambda _: nullcontext(client), http)
        else:
            # The key of this process is for its own user, and not for each client of the port.
            key = mcp_server.api_key
            mcp_server.serve_http(lambda headers: options.client(key(headers)), http)


# ------------------------------------------------------------------------------------ the scene


def _scene(
    context: typer.Context,
    things: list[str] | None,
    label_map: str | None,
    stated: list[str] | None = None,
    **options: str | None,
) -> dict[str, Any]:
    """Return the fields of the request from files and options. Options override files."""
    if things is None:
        _fail("the objects are missing: give labels, a file that ends in .json, or - for stdin")
    things = [part for thing in things for part in _labels(thing)]
    # Among other labels, a word such as "lamp" is a label, also if a file has this name.
    files = [one for one in things if is_file(one) and (len(things) == 1 or not one.isalpha())]
    if files and things != files[:1]:
        _fail(f"{files[0]} is a whole scene: remove the labels and other files")
    try:
        labels = None if label_map is None else label_map_of(label_map)
        scene = from_file(files[0], labels) if files else from_data(things, labels)
    except MessageError as error:
        _fail(str(error))
    if scene.notes and not scene["objects"]:
        _fail(f"{files[0]} has no object for a request: {scene.notes[0].detail}")
    for note in scene.notes[:_MAX_NOTES]:
        which = "" if note.detection is None else f"detection {note.detection}: "
        print(printable(f"{files[0]}: {which}{note.detail}"), file=sys.stderr)
    if (more := len(scene.notes) - _MAX_NOTES) > 0:
        print(printable(f"{files[0]}: {more} more notes of this kind"), file=sys.stderr)
    read = partial(_read, "--relations", read=phrases.relation)
    relations = [read(text) for text in stated] if stated else None
    general: Options = context.obj
    return scene | general.conventions | _named(relations=relations, **options)


def _named(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _labels(thing: str) -> list[str]:
    """Return the labels of an argument, which commas may separate; a file stays one argument."""
    if is_file(thing):
        return [thing]
    return [label.strip() for label in thing.split(",") if label.strip()]


def _read(option: str, text: str, read: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """Return the parts of the text of an option; see `phrases`."""
    try:
        return read(text)
    except ValueError as error:
        _fail(f"{option} {error}")


# ------------------------------------------------------------------------------------- errors


@contextmanager
def _exit_on_error() -> Iterator[None]:
    try:
        yield
    except ProblemError as problem:
        is_busy, is_refused = problem.status in (429, 503), 400 <= problem.status < 500
        _fail(str(problem), BUSY if is_busy else REFUSED if is_refused else FAILED)
    except UnreachableError as error:
        _fail(f"the service cannot be reached: {error}", UNREACHABLE)
    except DeadlineError as error:
        _fail(str(error), LATE)
    except (InvalidRequestError, ImportError, OSError) as error:
        _fail(str(error))
    except ClientError as error:
        _fail(str(error), FAILED)


def _fail(message: str, status: int = MEANINGLESS) -> NoReturn:
    Console(stderr=True, markup=False, highlight=False, emoji=False, soft_wrap=True).print(
        printable_lines(message), style="red"
    )
    raise typer.Exit(status)
