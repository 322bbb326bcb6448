"""The reader of all formats in the table ``formats.json``: where labels, scores and boxes lie.

A format has a name, paths that its data has (`has`), the path of its objects (`items`), and the
paths of their fields; see `scene_client.paths`. "x,y,z" are several values. The names in `fields`
find the fields that a format does not name. So one reader also reads tables and lists of records.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from functools import cached_property, lru_cache
from importlib.resources import files
from itertools import islice
from typing import Any, Final

from scene_client.boxes import IMAGE, NUMBER, SOLID, image, numeric, numerics, solid
from scene_client.image_plane import Box
from scene_client.paths import LOOKED_AT, Chain, each, get, leads
from scene_client.ros_fields import MessageError, frame_of, members, number, take, text, time_of
from scene_client.sightings import MAX_OBJECTS, Note, Reason, Seen, Sighting, Solid

Form = dict[str, Any]
"""An entry of the table of formats."""

TABLE: Final = json.loads(files("scene_client").joinpath("formats.json").read_text("utf-8"))
FORMATS: Final[list[Form]] = TABLE["formats"]
RECORDS: Final[Form] = TABLE["records"]
"""The format of a list of records, whose fields are found by their names."""
LABEL_MAP: Final[Form] = FORMATS[-1]
"""The format of a list of class names. Such a list describes a vocabulary instead of a scene."""
FIELDS: Final[dict[str, Any]] = TABLE["fields"]
"""Usual names of each kind of field, in the form of `key_of`."""

MAX_RECORDS: Final = 500_000
"""Maximum number of lines, messages or objects of a file."""

_SCENES: Final = [re.compile(pattern) for pattern in FIELDS["scene"]]  # places, frames, times
_UNITS: Final[dict[str, float]] = FIELDS["units"]
_CARRIES: Final[list[str]] = FIELDS["carries"]  # parts of the names of decisive fields
_MOST_NAMES: Final = 8  # of unread fields in a note
_MOST_RECORDS: Final = 4 * MAX_OBJECTS  # some have no label
_TURN: Final = 6.3  # radians; a larger yaw is in degrees
_LONGEST_TEXT: Final = 256  # characters of a text in which a pattern finds a field


class Rows(list[dict[str, Any]]):
    """Rows of a table. ``form`` is their format, and ``first`` the number of the first line."""

    def __init__(self, rows: Any, form: Form = RECORDS, first: int = 1) -> None:
        super().__init__(rows)
        self.form, self.first = form, first


def require_records(count: int) -> None:
    """Raise `MessageError` for more than `MAX_RECORDS` lines, messages or objects."""
    if count > MAX_RECORDS:
        raise MessageError(
            f"it has more than {MAX_RECORDS} lines or objects: cut out the scenes that you need"
        )


def matches(form: Form, data: Any) -> bool:
    """Return whether all paths in `has` lead to a value."""
    return "has" in form and all(leads(path, data) for path in form["has"])


pattern = lru_cache(maxsize=256)(re.compile)
"""A function that returns a pattern of the table; it compiles each one once."""


def spot(chain: Chain, spec: Any) -> Any:
    """Return the value that a format describes: paths, "x,y,z", or a path and a pattern."""
    if isinstance(spec, list):
        return next((value for one in spec if (value := spot(chain, one)) is not None), None)
    if isinstance(spec, dict):
        value = get(chain, spec["path"])
        if "match" not in spec or not isinstance(value, str):
            return value
        if len(value) > _LONGEST_TEXT:
            return None
        found = pattern(spec["match"]).search(value)
        return found[1] if found else None
    if "," not in spec:
        return get(chain, spec) if spec else None
    values = [get(chain, one) for one in spec.split(",")]
    return None if any(value is None for value in values) else values


# --------------------------------------------------------------------------------------- fields


def key_of(name: str) -> str:
    """Return the name of a field without capitals and separators."""
    return "".join(filter(str.isalnum, name)).lower()


@lru_cache(maxsize=1024)
def with_unit(name: str) -> tuple[str, float | None]:
    """Return the key of a name, and the factor of its unit, as in "x [mm]", or None."""
    stem = name.rstrip("])")
    end = max(map(stem.rfind, " _[("))
    factor = _UNITS.get(stem[end + 1 :]) if end > 0 else None
    return key_of(name if factor is None else stem[:end]), factor


def names_scene(name: str) -> int | None:
    """Return 0 for the name of a place, 1 for that of a frame, 2 for that of a time, or None."""
    key = key_of(name)
    return next((kind for kind, one in enumerate(_SCENES) if one.fullmatch(key)), None)


class Record:
    """An object of a file: its chain, and its fields by `key_of` their names.

    Attributes:
        used: names of the fields that the reader has taken.
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.node = chain[-1][1]
        self.used: set[str] = set()

    @cached_property
    def fields(self) -> dict[str, tuple[str, Any]]:
        """Pairs (name, value), also of the members of boxes and poses, by the keys of the names."""
        fields: dict[str, tuple[str, Any]] = {}
        nodes = [("", self.node, 0)]
        for owner, node, depth in nodes:
            for name, value in members(node):
                key, factor = with_unit(name)
                if factor is not None and _is_plain(value):
                    value = factor * numeric(value, name)
                fields.setdefault(key, (owner + name, value))
                if "." in name:  # of a flattened table, as in box.x1
                    fields.setdefault(key_of(name.rpartition(".")[2]), (name, value))
                if key in FIELDS["inside"] and depth < 3 and not isinstance(value, list | str):
                    nodes.append((f"{owner}{name}.", value, depth + 1))
        return fields

    def take(self, names: str) -> Any:
        """Return the value of a field, or those of "x,y,z"; None if one is missing."""
        pairs = [self.fields.get(name, ("", None)) for name in names.split(",")]
        if any(value is None or value == "" for _, value in pairs):
            return None
        self.used.update(name for name, _ in pairs)
        return [value for _, value in pairs] if "," in names else pairs[0][1]

    def first(self, kind: str) -> Any:
        """Return the first value of the fields of a kind, or None."""
        return next((v for n in FIELDS[kind] if (v := self.take(n)) is not None), None)

    def forget(self, names: str) -> None:
        """Count fields as not taken."""
        self.used -= {self.fields[name][0] for name in names.split(",") if name in self.fields}

    def unread(self) -> Iterator[str]:
        """Yield the names of the fields that carry a box, a score, a frame or a time, unread."""
        outer = {name for name, _ in members(self.node)}
        for key, (name, value) in self.fields.items():
            is_empty = value is None or value == "" or value == [] or value == {}
            is_used = any(one == name or one.startswith(f"{name}.") for one in self.used)
            axes = ({key[:-1] + axis for axis in "xyz"}, {axis + key[1:] for axis in "xyz"})
            is_axis = any(key in names and names <= self.fields.keys() for names in axes)
            carries = is_axis or key in FIELDS["carrying"] or any(map(key.__contains__, _CARRIES))
            if carries and not (is_empty or is_used or name not in outer):
                yield name


# --------------------------------------------------------------------------------------- scenes


def records_of(form: Form, data: Any) -> dict[str, list[Record]]:
    """Return the records of each scene of data by the names of the scenes."""
    items = form.get("items", "[]")
    paths = [items] if isinstance(items, str) else items
    chains = (chain for path in paths for chain in each(data, path))
    records = _few(Record(chain) for chain in chains)
    if "inner" in form:
        records = _few(
            Record((*one.chain, *inner[1:]))
            for one in records
            for inner in each(one.node, form["inner"])
        )
    for record in records:
        if "nested" in form:  # objects on other objects
            children = take(record.node, form["nested"]) or ()
            require_records(len(records) + len(children))
            records += [Record((*record.chain, child)) for child in enumerate(children)]
    if "lacks" in form:
        records = [one for one in records if spot(one.chain, form["lacks"]) is not None]
    if "unique" in form:
        records = [*{str(get(one.chain, form["unique"])): one for one in records}.values()]
    scenes: dict[str, list[Record]] = {}
    for name, record in zip(_scene_names(form, records), records, strict=True):
        scenes.setdefault(name, []).append(record)
    return scenes


def _few(records: Iterator[Record]) -> list[Record]:
    first = [*islice(records, MAX_RECORDS + 1)]
    require_records(len(first))
    return first


def _scene_names(form: Form, records: list[Record]) -> list[str]:
    """Return the name of the scene of each record: its image, its frame, its room or its time."""
    if "scene" in form:
        found = [spot(one.chain, form["scene"]) for one in records]
        if form["scene"] == "^.@":
            return [str(key + 1 if isinstance(key, int) else key) for key in found]
        return ["" if name is None else str(name) for name in found]
    if _is_named(form):
        return [""] * len(records)
    names = dict.fromkeys(name for one in records[:LOOKED_AT] for name in one.fields)
    varying: list[list[list[str]]] = [[], [], []]  # columns of places, of frames and of times
    for name in names:
        kind = names_scene(name)
        column = None if kind is None else _column(name, records)
        if kind is not None and column is not None and column not in varying[kind]:
            varying[kind].append(column)
    # The times of the objects of one frame may differ.
    columns = varying[0] + (varying[1] or varying[2])
    return [", ".join(parts) for parts in zip(*columns, strict=True)] or [""] * len(records)


def _column(name: str, records: list[Record]) -> list[str] | None:
    """Return the values of a field that names scenes, or None if they are equal or a frame."""
    values = [one.take(name) for one in records]
    column = [
        str(value) if _is_plain(value) else ".".join(map(str, (time_of(value) or {}).values()))
        for value in values
    ]
    is_frame = name in FIELDS["frame"] and not all(map(NUMBER.fullmatch, filter(None, column)))
    return None if len({*column}) < 2 or is_frame else column


def _is_named(form: Form) -> bool:
    """Return whether a format names the fields of its boxes."""
    return any(name in form for name in (*IMAGE, *SOLID))


def _is_plain(value: Any) -> bool:
    return isinstance(value, str | int | float) and value != ""


def read(form: Form, records: list[Record], data: Any) -> Seen:
    """Return what the records of one scene show. ``data`` is the whole data.

    Raises:
        MessageError: a value is text instead of a number.
    """
    return _Reader(form, data).seen(records)


class _Reader:
    def __init__(self, form: Form, data: Any) -> None:
        self.form, self.data, self.root = form, data, ((None, data),)
        self.notes: list[Note] = []
        names = get(self.root, form["names"]) if "names" in form else None
        if isinstance(names, list):
            names = {take(one, "id"): take(one, "name") for one in names}
        self.names = {str(key): name for key, name in (names or {}).items()}

    def note(self, reason: Reason, detail: str) -> None:
        self.notes.append(Note(None, reason, detail))

    def seen(self, records: list[Record]) -> Seen:
        form, chosen = self.form, self._chosen(records)
        if "group" in form:
            chosen = _merged(chosen, form["group"])
        scores, sightings = self.scores(chosen), []
        left_out = max(0, len(chosen) - _MOST_RECORDS)
        if left_out:  # most boxes need no conversion
            ranks = [-(number(score) or 0) for score in scores]
            kept = sorted(sorted(range(len(chosen)), key=ranks.__getitem__)[:_MOST_RECORDS])
            chosen, scores = [chosen[n] for n in kept], [scores[n] for n in kept]
        for n, record in enumerate(chosen):
            what = f"object {n + 1}"
            if isinstance(self.data, Rows):
                what = f"line {record.chain[-1][0] + self.data.first}"
            box, flat = self.boxes(record, what)
            name, is_numbered = self.name(record)
            is_unset = "zero" in form and take(record.node, "bbox") is not None
            sightings.append(
                Sighting(
                    self.label(record), scores[n], name, self.frame(record), box, flat,
                    is_unset=is_unset, is_numbered=is_numbered,
                )
            )  # fmt: skip
        self.to_radians(sightings)
        own = next((one.frame for one in sightings if one.frame), "")
        whole = frame_of(take(self.data, "header")) or frame_of(self.data)
        first, second = (own, whole) if "frame" in form else (whole, own)
        frame = first or second or ("map" if "map" in form else "")
        stamp = as_stamp(get(self.root, "header.stamp|stamp|timestamp"))
        stamp = next(filter(None, (self.stamp(one) for one in chosen[:1])), stamp)
        self.note_unread(chosen)
        is_list = form["name"] == RECORDS["name"] and not isinstance(self.data, Rows)
        is_bare = all(_is_plain(value) for one in chosen[:1] for _, value in one.fields.values())
        has_boxes = any(one.solid or one.image for one in sightings)
        if is_list and is_bare and not (has_boxes or self.notes):
            self.note("no-box", "there are no boxes: the results of a classifier are no objects")
        is_solid = form.get("is_solid")
        return Seen(sightings, frame, stamp, self.viewer(), is_solid, self.notes, left_out)

    def _chosen(self, records: list[Record]) -> list[Record]:
        """Return the records without those that the format marks as no objects."""
        skip = dict(self.form.get("skip", {}))
        what = skip.pop("what", "")
        chosen = [one for one in records if not any(_is(one, *pair) for pair in skip.items())]
        bare = self.form.get("bare", {"items": []})
        found = (one for path in bare["items"] for one in each(self.data, path))
        others = sum(get(one, bare.get("lacks", "-")) is None for one in found)
        for count, name in ((len(records) - len(chosen), what), (others, bare.get("what"))):
            if count:
                self.note("excluded", f"the scene leaves out {count} {name}")
        return chosen

    def label(self, record: Record) -> Any:
        if "label" in self.form:
            label = spot(record.chain, self.form["label"])
        else:
            found = [v for n in FIELDS["label"] if _is_plain(v := record.take(n))]
            words = (one for one in found if isinstance(one, str) and not NUMBER.fullmatch(one))
            label = next(words, found[0] if found else None)
        return self.names.get(str(label), label)

    def scores(self, records: list[Record]) -> list[Any]:
        """Return the scores from 0 to 1; 1 for a record without the field of a score."""
        spec, scores, is_percent = self.form.get("score"), [], self.form.get("percent", False)
        for n, one in enumerate(records, 1):
            score = one.first("score") if spec is None else spot(one.chain, spec)
            if isinstance(score, str):
                factor = 0.01 if score.strip().endswith("%") else 1.0
                score = factor * numeric(score.strip(" %"), f"object {n}, the score")
            is_unset = "is_solid" not in self.form and number(score) is None
            scores.append(1.0 if is_unset else score)
        finite = [value for one in scores if (value := number(one)) is not None]
        above = [score for score in finite if score > 1.5]
        is_alone = len(above) == 1 and any(0 < score < 1 for score in finite)
        if above and not (is_percent or is_alone) and max(finite) <= 100:
            is_percent = True
            self.note("percent", "the scores count as percent")
        if is_percent:
            scores = [one if number(one) is None else one / 100 for one in scores]
        return scores

    def boxes(self, record: Record, what: str) -> tuple[Solid | None, Box | None]:
        """Return the box with a position, or else the box in the image."""
        form, chain = self.form, record.chain
        if not _is_named(form):
            return self.found(record, what)
        values: dict[str, Any] = {
            n: v for n in SOLID if n in form and (v := spot(chain, form[n])) is not None
        }
        if form.get("is_aligned") and "size" in values:
            values.pop("degrees", None)
        box = self.set_box(values, what)
        if box is None and "else" in form:
            others = {n: v for n, s in form["else"].items() if (v := spot(chain, s)) is not None}
            box = self.set_box(others, what)
        if box is not None:
            return box, None
        kinds = ((kind, spot(chain, form[kind])) for kind in IMAGE if kind in form)
        kind, value = next(((kind, v) for kind, v in kinds if v is not None), ("", None))
        if "circle" in form and get(chain, form["circle"]) == "circle":
            kind = "circle"
        if kind and "scale" in form and kind != "spans":
            scale = numerics(spot(chain, form["scale"]) or [1.0, 1.0], what)
            value = [part * scale[n % 2] for n, part in enumerate(numerics(value, what))]
        tilt = math.radians(number(spot(chain, form.get("tilt", ""))) or 0.0)
        theta = number(spot(chain, form.get("theta", ""))) or tilt
        return None, image(kind, value, what, theta) if kind else None

    def set_box(self, values: Mapping[str, Any], what: str) -> Solid | None:
        """Return a box with a position. In some formats, one of zeros or without size is unset."""
        box = solid(self.form, values, what) if values else None
        unset = {"unset": box and box.is_unset, "size": box and box.sides is None}
        return None if unset.get(self.form.get("zero", "")) else box

    def found(self, record: Record, what: str) -> tuple[Solid | None, Box | None]:
        """Return the box of a record whose fields have usual names."""
        for names in FIELDS["span"]:
            if (value := record.take(names)) is not None:
                return solid(self.form, {"span": value}, f"{what}, {names}"), None
        # A box x, y, w, h lies in an image, also with a further column z.
        is_flat = {"w", "h"} <= record.fields.keys() and not {"d", "l"} & record.fields.keys()
        for names in FIELDS["position"]:
            if (value := None if is_flat and names == "x,y,z" else record.take(names)) is not None:
                is_text = isinstance(value, str) and "," not in value  # such as "kitchen"
                if not is_text and len(numerics(value, f"{what}, {names}")) == 3:
                    values = {"position": value}
                    for kind in ("size", "turn", "yaw"):
                        values[kind] = record.first(kind)
                    values = {kind: value for kind, value in values.items() if value is not None}
                    return solid(self.form, values, what), None
                record.forget(names)
        for kind, names in FIELDS["image"]:
            if (value := record.take(names)) is not None:
                if kind == "corners":  # further columns have the size of the image
                    record.used |= {"width", "height"}
                return None, image(kind, value, f"{what}, {names}")
        return None, None

    def to_radians(self, sightings: list[Sighting]) -> None:
        """Convert yaws in degrees, which are larger than those in radians."""
        yaws = [one.solid.yaw for one in sightings if one.solid and one.solid.yaw is not None]
        if any(abs(yaw) > _TURN for yaw in yaws) and "degrees" not in self.form:
            self.note("degrees", "yaw counts in degrees")
            for one in sightings:
                if one.solid and one.solid.yaw is not None:
                    one.solid = one.solid._replace(yaw=math.radians(one.solid.yaw))

    def name(self, record: Record) -> tuple[str, bool]:
        """Return the id of the detection, and whether it is a number that follows the label."""
        if (spec := self.form.get("id")) is not None:
            return text(spot(record.chain, spec)), isinstance(spec, dict)
        found = ((n, v) for n in FIELDS["id"] if (v := record.take(n)) is not None)
        name, value = next(found, ("", ""))
        return text(value), name[:5] == "track" or not isinstance(value, str)

    def frame(self, record: Record) -> str:
        if "frame" in self.form:
            return text(get(record.chain, self.form["frame"])).lstrip("/")
        if _is_named(self.form):
            return frame_of(take(record.node, "header")) or frame_of(record.node)
        found = (text(record.take(name)) for name in FIELDS["frame"])
        frame = next((one for one in found if one and not NUMBER.fullmatch(one)), "")
        return frame.lstrip("/")

    def stamp(self, record: Record) -> Any:
        if "stamp" in self.form or _is_named(self.form):
            return as_stamp(spot(record.chain, self.form.get("stamp", "")))
        for name in FIELDS["time"]:
            if (stamp := time_of(as_stamp(record.take(name)))) is not None:
                return stamp
            record.forget(name)
        return None

    def viewer(self) -> dict[str, float] | None:
        agent = get(self.root, self.form["viewer"]) if "viewer" in self.form else None
        at, yaw = take(agent, "position"), number(take(agent, "rotation", "y"))
        box = solid(self.form, {"position": at, "degrees": yaw}, "viewer") if agent else None
        if box is None or box.yaw is None:
            return None
        return {"x": box.position[0], "y": box.position[1], "yaw": box.yaw}

    def note_unread(self, records: list[Record]) -> None:
        """Note the fields that carry a box, a score, a frame or a time, and are not read."""
        if "is_solid" in self.form:  # the layout of a ROS message is known
            return
        known = {*re.findall(r"\w+", json.dumps(self.form))}
        names = dict.fromkeys(name for one in records[:LOOKED_AT] for name in one.unread())
        if unread := [name for name in names if name not in known]:
            more = ", …" if len(unread) > _MOST_NAMES else ""
            named = ", ".join(unread[:_MOST_NAMES])[:200] + more
            self.note("unread", f"these fields are not read: {named}")


def _is(record: Record, path: str, values: list[Any]) -> bool:
    """Return whether a field has one of the values; "*" is any value."""
    value = get(record.chain, path)
    return value in values or (value is not None and values == ["*"])


def _merged(records: list[Record], path: str) -> list[Record]:
    """Join the points of records of one group, which are parts of one object."""
    groups: dict[Any, dict[str, Any]] = {}
    for record in records:
        group = get(record.chain, path)
        key = (str(record.node["label"]), id(record) if group is None else str(group))
        points = groups.get(key, {"points": []})["points"]
        groups[key] = {**record.node, "points": [*points, *record.node["points"]]}
    return [Record(((None, None), (n, thing))) for n, thing in enumerate(groups.values())]


def as_stamp(value: Any) -> Any:
    """Convert seconds, ms, µs or ns since 1970 to a time of ROS; return other values unchanged."""
    if isinstance(value, str) and NUMBER.fullmatch(value):
        value = float(value)
    if (seconds := number(value)) is None:
        return None if isinstance(value, str) else value
    while abs(seconds) > 1e11:
        seconds /= 1000
    whole, part = divmod(round(seconds * 1e6), 1_000_000)  # a float of today has no nanoseconds
    return {"sec": whole, "nanosec": 1000 * part}
