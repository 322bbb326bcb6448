"""Parsing of files: the bytes of JSON, YAML, XML, MCAP, tables and lists become data."""

from __future__ import annotations

import ast
import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, Final
from xml.etree import ElementTree

from scene_client.boxes import NUMBER
from scene_client.records import (
    FIELDS,
    TABLE,
    Form,
    Rows,
    key_of,
    pattern,
    require_records,
)
from scene_client.ros_fields import MessageError

_MOST_YAML: Final = 2**19  # bytes; PyYAML is slow
MOST_MESSAGES: Final = 2**26
"""Maximum size of the chunks of a recording after decompression in bytes."""

MAX_VALUES: Final = 4_000_000
"""Maximum number of values in a text. Each takes up to 100 bytes of memory, in place of two."""
_IN_JSON, _IN_XML = ",[{", "<="  # the marks of the values
_IN_LINES: Final = ",;\t| \n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"
MOST_MESSAGE: Final = 2**20
"""Maximum size of a message in bytes. An array of tiny messages takes 250 times its size."""

_PART: Final = 2**16  # characters of XML
_START: Final = 2000  # characters in which a refused format shows
_BEFORE: Final = r"(?is)\s*(?:<\?xml[^>]*>\s*)?(?:<!--(?:(?!-->).)*-->\s*)?(?:#\s[^\n]*\n\s*)*"
_FENCE: Final = re.compile(r"```(?:\w+)?[ \t]*\n(.*?)```", re.DOTALL)
_COMMENT: Final = re.compile(r"#(\s|$)")
_ITEMS: Final = re.compile(r"\bitem\s*\{([^{}]*)\}")
_MEMBERS: Final = {
    name: re.compile(rf"\b{name}\s*:\s*(?:\"([^\"]*)\"|'([^']*)'|(\S+))")
    for name in ("id", "name", "display_name")
}
_NUMBERED: Final = re.compile(r"(\d+|/[mgt]/\w+)([,;:=\t]| [,;:=]?)[ \t]*([^\d\s,;:=].*)")
_ITEM: Final = re.compile(r"(?:[-*•+]|\d{1,3}[.)])[ \t]+(?=\S)")
_YAML: Final = re.compile(r"---(\s|$)|- |[\w./* -]{1,64}:(\s|$)")
_DEEPEST: Final = 64  # nesting of YAML and XML
_LONGEST: Final = 5  # words of a label; more of them are a sentence


def parsed(content: bytes) -> Any:
    """Return the data of a file: a JSON value, `Rows`, a list of labels, an `Xml`, or `Parts`.

    Raises:
        MessageError: the content is not text, or has an unknown format.
    """
    _refuse(content[:_START].decode("latin-1").removeprefix("\u00ef\u00bb\u00bf"))
    if content.startswith(b"\x89MCAP"):
        return _messages(content)
    return data_of(text_of(content))


class Parts(dict[str, Callable[[], Any]]):
    """Functions that return the data of each scene: a line, a document, or a message."""


class Xml(dict[str, Any]):
    """The root of a file in XML, by its name."""


class Yaml(dict[str, Any]):
    """A value of a file in YAML."""


def text_of(content: bytes) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with a mark of its byte order.

    Raises:
        MessageError: the content is not text.
    """
    is_wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = content.decode("utf-16" if is_wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise MessageError("this is no text in UTF-8, and no other known format: save it as UTF-8")
    return text


def _refuse(start: str) -> None:
    for form in TABLE["refused"]:
        if pattern(f"{_BEFORE}(?:{form['match']})").match(start):
            raise MessageError(f"this is {form['name']}: {form['use']}")


def data_of(text: str) -> Any:
    """Return the data of a text, as `parsed` does."""
    text = text.removeprefix("\ufeff")
    require_few(text, "`", 8)
    if len(blocks := _FENCE.findall(text)) > 1:  # of a language model
        return Parts({str(n): partial(data_of, block) for n, block in enumerate(blocks, 1)})
    text = blocks[0] if blocks else text
    start = text.lstrip()[:1]
    if start == "<":
        return _xml(text)
    if start in ("{", "["):
        return _json(text)
    require_few(text, _IN_LINES)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines = [one for one in lines if not _COMMENT.match(one) and one != "???"]
    lines = lines[1:] if lines and lines[0].startswith("sep=") else lines  # of Excel
    if not lines:
        raise MessageError("the file is empty")
    require_records(len(lines))
    if items := _ITEMS.findall(text):  # a label map of TensorFlow
        return {_member(item, "id"): _member(item, "display_name", "name") for item in items}
    for parse in (_table, _numbers, _lines, _labels):
        if (data := parse(lines)) is not None:
            return data
    if _YAML.match(lines[0]) and (data := _yaml(text)) is not None:
        return data
    raise MessageError(_what_text(lines))


def require_few(text: str, marks: str, share: int = 1) -> None:
    """Raise `MessageError` for more than `MAX_VALUES` / share values, before they take memory.

    ``marks`` are the characters between values.
    """
    most = MAX_VALUES // share
    if sum(map(text.count, marks)) > most:
        raise MessageError(f"it has more than {most} values: cut out the scenes that you need")


def _member(item: str, *names: str) -> str:
    found = (_MEMBERS[name].search(item) for name in names)
    return next((part for one in found if one for part in one.groups() if part), "")


def _json(text: str) -> Any:
    require_few(text, _IN_JSON)
    first, _, rest = text.strip().partition("\n")
    if rest.strip() and first.rstrip().endswith(("}", "]")):
        try:
            json.loads(first)
        except (ValueError, RecursionError):
            pass
        else:
            require_records(text.count("\n"))
            lines = enumerate(text.split("\n"), 1)
            return Parts({str(n): partial(json_value, one, n) for n, one in lines if one.strip()})
    return json_value(text)


def json_value(text: str, line: int = 1) -> Any:
    """Return the value of a text in JSON. ``line`` is the number of its first line.

    Raises:
        MessageError: the text is not JSON, or has more than `MAX_VALUES` values.
    """
    require_few(text, _IN_JSON)
    try:
        return json.loads(text)
    except RecursionError:
        raise MessageError("this is not JSON that can be read: its nesting is too deep") from None
    except json.JSONDecodeError as error:
        if (value := _of_python(text)) is not None:
            return value
        where = f"line {line + error.lineno - 1}, column {error.colno}"
        end = "; the file ends too early" if error.pos >= len(text.rstrip()) - 1 else ""
        raise MessageError(f"this is not JSON that can be read: see {where}{end}") from None
    except ValueError:
        raise MessageError("this is not JSON that can be read: a number is too long") from None


# ------------------------------------------------------------------------------------ lines


def _table(lines: list[str]) -> Rows | None:
    """Return the rows of a table, or None if the first line does not name the columns."""
    delimiter = max(",;\t|", key=lines[0].count)
    if delimiter == "|":  # of Markdown
        lines = [one.strip("| ") for one in lines if not re.fullmatch(r"[|:\- ]+", one)]
        if not lines:
            return None
    names = [name.strip().strip('"') for name in lines[0].split(delimiter)]
    keys = [key_of(name) for name in names]
    if len(names) < 2 or not set(FIELDS["label"]) & {*keys} or any(map(_is_number, names)):
        return None
    if len({*keys} - {""}) < sum(map(bool, keys)):
        raise MessageError("this is a table with two columns of the same name")
    # A comma in a number of such a table is a decimal point.
    has_commas = delimiter != ","
    rows = csv.reader(lines[1:], delimiter=delimiter, strict=True)
    try:
        return Rows(
            (
                {name: _cell(cell, has_commas) for name, cell in zip(names, row, strict=False)}
                for row in rows
            ),
            first=2,
        )
    except csv.Error as error:
        raise MessageError(f"this is not a table that can be read: {error}") from None


def _cell(cell: str, has_commas: bool) -> Any:
    cell = cell.strip()
    if has_commas and re.fullmatch(r"[+-]?\d+,\d+", cell):
        return cell.replace(",", ".")
    if cell.startswith(("[{", "{")):
        with suppress(MessageError):
            return json_value(cell)
    return cell


def _of_python(text: str) -> Any:
    """Return the value of dictionaries as Python prints them, or None for other text."""
    if not re.match(r"\s*\[?\{'", text) or len(text) > _START * 32:
        return None
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return None


def _numbers(lines: list[str]) -> Rows | None:
    """Return the rows of a file of YOLO: class, box, score and track; or class and outline."""
    words = [line.split() for line in lines]
    if not all(len(line) >= 5 and all(map(_is_number, line)) for line in words):
        return None
    if not all(line[0].isdecimal() for line in words):
        return None
    last = {line[-1] for line in words if len(line) in (6, 7)}
    has_tracks = all(map(str.isdecimal, last)) and bool(last - {"0", "1"} or len(last) > 1)
    return Rows(_yolo(line, has_tracks and len(line) in (6, 7)) for line in words)


def _yolo(words: list[str], has_track: bool) -> dict[str, Any]:
    track = words.pop() if has_track else ""
    label, values = words[0], [float(word) for word in words[1:]]
    score = values.pop() if len(values) % 2 else 1.0
    box = {"xcenter": 0, "ycenter": 1, "width": 2, "height": 3}
    shape = {n: values[at] for n, at in box.items()} if len(values) == 4 else {"points": values}
    return {"class_id": label, "score": score, "track_id": track, **shape}


def _lines(lines: list[str]) -> Rows | None:
    """Return the rows of lines in one of the formats of the table."""
    for form in TABLE["lines"]:
        if "match" in form:
            kept, found, image = [], [], ""
            for line in lines:
                if head := pattern(form["drop"]).fullmatch(line):
                    image = head[1] or image
                else:
                    kept.append(line)
                    found.append((image, pattern(form["match"]).fullmatch(line)))
            rows = [{"image": image, **one.groupdict()} for image, one in found if one]
        else:
            names = form["words"].split()
            rows = [row for line in lines if (row := _row(line.split(), names, form)) is not None]
            kept = lines
        if rows and len(rows) == len(kept):
            return Rows(rows, form if "position" in form else TABLE["records"])
    return None


def _row(words: list[str], names: list[str], form: Form) -> dict[str, str] | None:
    """Return the fields of a line: a label, which may have several words, and numbers."""
    words = words[:-1] if words[-1] == "difficult" else words
    count = next((n for n, word in enumerate(words) if _is_number(word)), len(words))
    numbers = words[count:]
    if not count or not form["least"] <= 1 + len(numbers) <= len(names):
        return None
    if not all(map(_is_number, numbers)):
        return None
    return dict(zip(names, [" ".join(words[:count]), *numbers], strict=False))


def _labels(lines: list[str]) -> list[str] | dict[str, str] | None:
    """Return the labels of a list or a caption: one a line, or with separators between them."""
    if len(lines) == 1:
        separators = (" | ", " . ", ",", ";")
        separator = max(separators, key=lines[0].count)
        if lines[0].endswith(".") and separator == ",":  # a sentence
            return None
        labels = [one.removeprefix("and ") for one in lines[0].rstrip(" .").split(separator)]
    elif all(map(_ITEM.match, lines)):
        labels = [_ITEM.sub("", line, count=1) for line in lines]
    else:
        labels = [label for line in lines for label in line.split(",")]
    labels = [label.strip() for label in labels if label.strip()]
    numbered = [found for line in lines if (found := _NUMBERED.fullmatch(line))]
    counted = ([str(first + n) for n in range(len(lines))] for first in (0, 1))
    # "2 chairs" can be a number of things.
    is_map = all(one[2].strip() for one in numbered) or [one[1] for one in numbered] in counted
    if is_map and len(numbered) == len(lines):
        return {one[1]: one[3].partition(" #")[0].strip(" '\"") for one in numbered}
    if any(map(_is_no_label, labels)):
        return None
    return labels


def _is_no_label(label: str) -> bool:
    """Return whether a text is a sentence, or has marks of data or a number as a word."""
    words = label.split()
    has_number = any(_is_number(word.strip("()%,;")) for word in words)
    has_marks = re.search(r'[{}\[\]":;<=#!?]|\*\*|\.\s', label) is not None
    return has_number or has_marks or len(words) > _LONGEST or label in ("null", "true", "false")


def _is_number(word: str) -> bool:
    return NUMBER.fullmatch(word) is not None or word.lower() in ("nan", "inf", "-inf")


def _what_text(lines: list[str]) -> str:
    cells = re.split(r"[,;\t]", lines[0])
    if len(cells) > 2 and any(map(_is_number, map(str.strip, cells))):
        return "this is a table without a header: name its columns, such as label,x,y,z"
    start = lines[0][:60]
    return (
        f"this is text of no known format, which starts with {start!r}: send JSON, a table with "
        "the column label, or one label a line"
    )


# ------------------------------------------------------------------------- YAML, XML and MCAP


def _extra(module: str) -> Any:
    """Return a module of the extra ``files``.

    Raises:
        MessageError: the module is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        package, remedy = module.partition(".")[0], "pip install 'scene-client[files]'"
        raise MessageError(f"this format needs the package {package}: {remedy}") from None


def _yaml(text: str) -> Any:
    """Return the value of a text in YAML, or None for other text."""
    values = [value for value in _yaml_values(text) if value not in (None, "")]
    if not all(isinstance(value, dict | list) for value in values):
        return None
    if len(values) == 1:
        return Yaml(values[0]) if isinstance(values[0], dict) else values[0]
    return Parts({str(n): partial(copy, value) for n, value in enumerate(values, 1)})


def _yaml_values(text: str) -> list[Any]:
    """Return the documents of a text in YAML, as `ros2 topic echo` prints them.

    Raises:
        MessageError: the text is not YAML, or has anchors, or PyYAML is not installed.
    """
    yaml = _extra("yaml")
    if len(text) > _MOST_YAML:
        raise MessageError(f"this is YAML of more than {_MOST_YAML} characters: convert it to JSON")
    depth, deepest = 0, max(len(line) - len(line.lstrip(" -?")) for line in text.splitlines())
    for mark in re.findall(r"[\[\]{}]", text):
        depth += 1 if mark in "[{" else -1
        deepest = max(deepest, 2 * depth)
    if deepest > 2 * _DEEPEST:
        raise MessageError("this is YAML that cannot be read: its nesting is too deep")
    try:
        # An alias stands for a part of the document again. A small text could mean a huge value.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.BaseLoader)):
            raise MessageError("this is YAML with aliases (*), which this program does not read")
        # The other loaders read the label "no" as a boolean.
        return [_typed(value) for value in yaml.load_all(text, yaml.BaseLoader)]
    except MessageError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f": see line {mark.line + 1}" if mark else ""
        raise MessageError(f"this is not YAML that can be read{where}") from None


def _typed(value: Any) -> Any:
    """Return a value of YAML with numbers in place of their texts."""
    if isinstance(value, dict):
        return {key: _typed(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_typed(part) for part in value]
    if value in ("", "~", "null"):
        return "" if value == "" else None
    if NUMBER.fullmatch(value):
        return int(value) if re.fullmatch(r"[+-]?\d{1,18}", value) else float(value)
    return value


def _xml(text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise MessageError("this is XML with a document type, which this program does not read")
    require_few(text, _IN_XML, 4)
    try:
        # Expat bounds the expansion of entities, and a document type is refused above. Between two
        # parts of the text, other threads run.
        parser, step = ElementTree.XMLParser(), max(_PART, len(text) // 32)  # noqa: S314
        for at in range(0, len(text), step):
            parser.feed(text[at : at + step])
        root = parser.close()
    except ElementTree.ParseError as error:
        line = error.position[0]
        raise MessageError(f"this is not XML that can be read: see line {line}") from None
    try:
        return Xml({root.tag: _element(root)})
    except RecursionError:
        raise MessageError("this is XML that cannot be read: its nesting is too deep") from None


def _element(element: ElementTree.Element) -> Any:
    """Return the attributes and children of an element; its text if it has neither."""
    if not len(element) and not element.attrib:
        return (element.text or "").strip()
    value: dict[str, Any] = dict(element.attrib)
    for child in element:
        inner = _element(child)
        if child.tag not in value:
            value[child.tag] = inner
        elif isinstance(value[child.tag], list):
            value[child.tag].append(inner)
        else:
            value[child.tag] = [value[child.tag], inner]
    return value


def _messages(content: bytes) -> Parts:
    """Return the messages of a recording (MCAP) by topic and number: of ROS 2, or in JSON."""
    reader, kinds = _extra("mcap.stream_reader"), _extra("mcap.records")
    factory = _extra("mcap_ros2.decoder").DecoderFactory()
    schemas, channels, parts, left = {}, {}, Parts(), MOST_MESSAGES
    counts: Counter[str] = Counter()
    try:
        stream = reader.StreamReader(io.BytesIO(content), emit_chunks=True)
        for outer in stream.records:
            chunk = _unpacked(outer, left) if isinstance(outer, kinds.Chunk) else None
            left -= len(chunk.data) if chunk else 0
            for record in reader.breakup_chunk(chunk) if chunk else (outer,):
                if isinstance(record, kinds.Schema):
                    schemas[record.id] = record
                elif isinstance(record, kinds.Channel):
                    channels[record.id] = record
                elif isinstance(record, kinds.Message):
                    channel = channels[record.channel_id]
                    schema, coding = schemas.get(channel.schema_id), channel.message_encoding
                    decode = _json_of if coding == "json" else factory.decoder_for(coding, schema)
                    if decode is not None:
                        require_records(len(parts) + 1)
                        counts[channel.topic] += 1
                        name = f"{channel.topic}:{counts[channel.topic]}"
                        parts[name] = partial(_decoded, decode, record.data)
    except MessageError:
        raise
    except Exception:  # noqa: BLE001 — of any of three libraries
        raise MessageError("this is a recording (MCAP) that is damaged or ends too early") from None
    return parts


def _json_of(data: bytes) -> Any:
    return json_value(text_of(data))


def _decoded(decode: Callable[[bytes], Any], data: bytes) -> Any:
    if len(data) > MOST_MESSAGE:
        raise MessageError(f"this message has more than {MOST_MESSAGE} bytes")
    try:
        return decode(data)
    except MessageError:
        raise
    except Exception:  # noqa: BLE001 — of any of three libraries
        raise MessageError("this message does not fit its schema") from None


def _unpacked(chunk: Any, most: int) -> Any:
    """Return a chunk of a recording with its data as they are, of at most so many bytes."""
    if chunk.compression == "zstd":
        stream = _extra("zstandard").ZstdDecompressor().stream_reader(chunk.data)
        data = stream.read(most + 1)
    elif chunk.compression == "lz4":
        data = _extra("lz4.frame").LZ4FrameDecompressor().decompress(chunk.data, most + 1)
    else:
        data = chunk.data
    if len(data) > most:
        raise MessageError(f"this is a recording of more than {MOST_MESSAGES} bytes")
    return replace(chunk, data=data, compression="")
