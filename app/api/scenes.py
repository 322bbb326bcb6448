"""The route that reads files of detectors, annotation tools and simulators for the page.

The readers are those of the client (`scene_client.files`). The service stores nothing.
"""

import binascii
from collections.abc import Callable
from typing import Final

from fastapi import APIRouter
from pydantic_core import to_json
from starlette.requests import Request

from app.api.body import JSONRoute
from app.api.openapi import error_responses, operation_id
from app.errors import InvalidRequestError, UnreadableFileError
from app.serving.runtime import Runtime
from scene_client.files import labels_in, scenes_of
from scene_client.parsing import text_of
from scene_client.ros_fields import MessageError
from scene_client.schemas import MAX_BATCH, FieldError, FileNote, ScenesAnswer, ScenesRequest

MOST_PARTS: Final = 32768
"""Maximum number of lines, lists, objects, elements or attributes in a file, each.

The parsers of JSON and XML hold the interpreter lock. This number bounds their time to 0.1 s, and
the time of the conversion to about a second.
"""

# The first marks end lines, as `str.splitlines` finds them. The others stand between parts.
_MARKS: Final = {
    **dict.fromkeys("\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029[{<=", 1),
    **dict.fromkeys((",", ";", "|", " . "), 8),
}
"""Maximum number of each mark in a file, times `MOST_PARTS`."""

_MOST_NOTES: Final = 16  # of one scene
_MOST_CHARACTERS: Final = 300  # of one message

router = APIRouter(
    tags=["files"],
    route_class=JSONRoute,
    responses=error_responses("admission", "body", "file", "models"),
    generate_unique_id_function=operation_id,
)


@router.post("/scenes", summary="The scenes of a file", response_model=ScenesAnswer)
async def scenes(data: ScenesRequest, http: Request) -> bytes:
    """Convert a file of a detector, an annotation tool or a simulator to the fields of requests.

    The answer has the first 256 scenes of the file. The service stores nothing.
    """
    runtime: Runtime = http.app.state.runtime
    state, limit = http.scope["state"], runtime.limits.answer_bytes
    return await runtime.admission.in_worker(
        state["ticket"], lambda stop: _read(data, state["request_id"], limit, stop)
    )


def _read(data: ScenesRequest, request_id: str, limit: int, stop: Callable[[], bool]) -> bytes:
    """Return the answer as JSON, with at most ``limit`` bytes of scenes. ``stop`` ends it early."""
    content = _content(data)
    try:
        _require_few(content)
        labels = None if data.label_map is None else labels_in(data.label_map)
        readers = scenes_of(content, labels)
    except MessageError as error:
        raise UnreadableFileError(detail=_in_one_line(str(error))) from None
    converted: list[bytes] = []
    notes: list[FileNote] = []
    size = 0

    def note(scene: int | None, detection: int | None, reason: str, detail: str) -> None:
        line = _in_one_line(detail)
        notes.append(FileNote(scene=scene, detection=detection, reason=reason, detail=line))

    for number, (name, read) in enumerate(readers.items()):
        if number == MAX_BATCH or size > limit or stop():
            omitted = f"the answer leaves out {len(readers) - number} of {len(readers)} scenes"
            note(None, None, "too-many", omitted)
            break
        try:
            fields = read()
            scene = to_json({"name": name, "scene": fields}, inf_nan_mode="null")
            size += len(scene)
            if size > limit:
                raise MessageError(f"the answer has no room for this scene: {limit} bytes at most")
        except (ValueError, RecursionError) as error:
            words = str(error) if isinstance(error, MessageError) else "a value is not valid JSON"
            note(None, None, "refused", f"{name}: {words}" if name else words)
            continue
        for detection, reason, detail in fields.notes[:_MOST_NOTES]:
            note(len(converted), detection, reason, detail)
        converted.append(scene)
    if not converted:
        raise UnreadableFileError(detail=notes[0].detail if notes else "The file is empty.")
    return b'{"request_id":%b,"scenes":[%b],"notes":%b}' % (
        to_json(request_id),
        b",".join(converted),
        to_json(notes),
    )


def _require_few(content: bytes) -> None:
    """Raise MessageError if a file in text has too many parts."""
    try:
        text = text_of(content)
    except MessageError:  # `scenes_of` knows some other formats
        return
    if any(text.count(mark) > most * MOST_PARTS for mark, most in _MARKS.items()):
        words = f"The file has more than {MOST_PARTS} entries. The command `scene` reads it."
        raise MessageError(words)


def _content(data: ScenesRequest) -> bytes:
    """Return the bytes of the file in a request, which are sent as text or as Base64."""
    if data.text is not None:
        return data.text.encode()
    try:
        return binascii.a2b_base64(data.base64 or "", strict_mode=True)
    except ValueError:
        wrong = FieldError(pointer="#/base64", message="must be Base64")
        raise InvalidRequestError(errors=[wrong]) from None


def _in_one_line(message: str) -> str:
    """Return the start of a message, without line breaks and other unprintable characters."""
    words = " ".join(message[:_MOST_CHARACTERS].split())
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in words)
