"""Every kind of problem the service reports: its stable name, its status and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class ProblemType:
    """A kind of problem.

    Attributes:
        slug: last segment of its ``type``; stable, programs branch on it.
        status: HTTP status.
        title: the same for every occurrence.
        explanation: what it means and what to do, for its page.
    """

    slug: str
    status: int
    title: str
    explanation: str

    @property
    def uri(self) -> str:
        """The ``type`` member (RFC 9457, section 3.1.1)."""
        return f"/problems/{self.slug}"


NOT_JSON: Final = ProblemType(
    "not-json",
    400,
    "The body is not acceptable JSON",
    "The body must be one JSON value in UTF-8 without a byte order mark. NaN and Infinity, lone "
    "surrogates, a member name used twice in one object and nesting deeper than 200 are refused, "
    "because receivers read such texts in different ways.",
)
BAD_REQUEST: Final = ProblemType(
    "bad-request",
    400,
    "The request could not be read",
    "The connection broke off before the body was complete, or X-Request-Timeout-Ms is not a whole "
    "number of milliseconds from 1 to SCENE_MAX_REQUEST_TIMEOUT_MS.",
)
REQUEST_TIMEOUT: Final = ProblemType(
    "request-timeout",
    408,
    "The request did not come in time",
    "The body of a request must arrive within SCENE_CLIENT_TIMEOUT seconds of its head. "
    "The connection is closed; send the request again on a new one.",
)
HOST_REFUSED: Final = ProblemType(
    "host-refused",
    421,
    "The service does not answer under this name",
    "The Host header must be one of the names in SCENE_ALLOWED_HOSTS; the port does not matter. "
    "By default these are 127.0.0.1, localhost, [::1] and the address in SCENE_HOST. "
    "Add the name that your clients use. Health checks answer under every name.",
)
UNAUTHORIZED: Final = ProblemType(
    "unauthorized",
    401,
    "A valid key is required",
    "Administration needs the admin key, as X-Admin-Key or as Authorization: Bearer; a service "
    "that was started without SCENE_ADMIN_KEY refuses every one. A service that was started with "
    "SCENE_API_KEY asks for that key on every other route, as X-API-Key or as Authorization: "
    "Bearer, but for health and pages such as this.",
)
ORIGIN_REFUSED: Final = ProblemType(
    "origin-refused",
    403,
    "Pages of this origin may not ask this",
    "A browser asked whether a page from elsewhere may send a request. Origins are allowed by "
    "SCENE_CORS_ORIGINS, and they may ask questions and read; administration is not for pages.",
)
NOT_FOUND: Final = ProblemType(
    "not-found",
    404,
    "There is nothing at this address",
    "No route has this path. /openapi.json lists the routes, unless SCENE_DOCS is off.",
)
MODEL_NOT_FOUND: Final = ProblemType(
    "model-not-found",
    404,
    "No such model or version",
    "A model is named by an alias, by its name (its newest version answers), or as name@version. "
    "GET /models lists them.",
)
METHOD_NOT_ALLOWED: Final = ProblemType(
    "method-not-allowed",
    405,
    "This route does not take this method",
    "The Allow header lists the methods it takes.",
)
ALIAS_CONFLICT: Final = ProblemType(
    "alias-conflict",
    409,
    "The alias does not point where the request expected",
    "Somebody else moved the alias. Read GET /models, decide again, and send the new `expected`.",
)
MODEL_UNUSABLE: Final = ProblemType(
    "model-unusable",
    409,
    "This model cannot take an alias",
    "The version exists but was refused when it was loaded; GET /models says why.",
)
REFRESH_REFUSED: Final = ProblemType(
    "refresh-refused",
    409,
    "The store was not taken over",
    "Something in the store is worse than what is being served: a version that did not verify, did "
    "not answer its warm-up, or an alias that leads to none. "
    "Nothing has changed: the versions served before still answer. `failures` names what was "
    "refused and why.",
)
STORE_NOT_WRITABLE: Final = ProblemType(
    "store-not-writable",
    409,
    "The store cannot be written",
    "Aliases are kept in the store, and this service cannot write them there. Move the alias where "
    "the store is writable, then POST /models/refresh.",
)
STORE_BUSY: Final = ProblemType(
    "store-busy",
    503,
    "The store is being written by somebody else",
    "Another process holds the store's lock, for example while it publishes a version. "
    "Retry-After says when to ask again.",
)
BODY_TOO_LARGE: Final = ProblemType(
    "body-too-large",
    413,
    "The body is over the limit",
    "Send fewer scenes at once. The limit, SCENE_MAX_BODY_BYTES, holds for chunked bodies too.",
)
BODIES_FULL: Final = ProblemType(
    "bodies-full",
    503,
    "The service holds too many bytes of request bodies",
    "Bodies of all requests in progress may take SCENE_HELD_BODY_BYTES together. Bodies of at most "
    "64 KiB that arrive at once are always accepted. Retry-After says when to ask again.",
)
UNSUPPORTED_MEDIA_TYPE: Final = ProblemType(
    "unsupported-media-type",
    415,
    "The body is not declared as JSON",
    "Send Content-Type: application/json.",
)
INVALID_REQUEST: Final = ProblemType(
    "invalid-request",
    422,
    "The request does not fit",
    "The body is JSON, but not what this route takes. `errors` lists what is wrong: `pointer` is a "
    "JSON pointer into the body, `suggestions` the nearest known names.",
)
UNKNOWN_LABELS: Final = ProblemType(
    "unknown-labels",
    422,
    "The model does not know some of the labels",
    "`errors` points at each label and suggests the nearest known ones. With `unknown_labels` set "
    "to `ignore` the service answers without them and lists them in `ignored`; with `nearest` it "
    "maps each to the nearest class, lists it in `mapped`, and refuses labels that are like none. "
    "GET /models/{name}/vocabulary lists every label.",
)
CONTRADICTORY_EVIDENCE: Final = ProblemType(
    "contradictory-evidence",
    422,
    "The scene contradicts itself",
    "No scene can be like that: an object stands in a relation to itself, or a pair stands both in "
    "a relation and in its opposite (left and right, on-top and under).",
)
ANSWER_TOO_LARGE: Final = ProblemType(
    "answer-too-large",
    422,
    "The answer would be too large",
    "The answer would exceed SCENE_MAX_ANSWER_BYTES. `errors` points at the parameter to lower: "
    "`top_k` or `count`, or the number of `objects`. Shorter ids help too. All scenes of a batch "
    "share one limit: send the refused scenes in another request.",
)
QUEUE_FULL: Final = ProblemType(
    "queue-full",
    429,
    "Too much is waiting already",
    "More requests are waiting than the service holds (SCENE_QUEUE_REQUESTS), or than leave this "
    "one enough of its time, or more scenes for this model (SCENE_QUEUE_ROWS). Nothing of this one "
    "was computed. Retry-After says when to ask again.",
)
DEADLINE_PASSED: Final = ProblemType(
    "deadline-passed",
    504,
    "The deadline passed",
    "The time of the request, X-Request-Timeout-Ms or else SCENE_REQUEST_TIMEOUT_MS, was over "
    "before its answer was there. Its work was dropped.",
)
DRAINING: Final = ProblemType(
    "draining",
    503,
    "The service is ending",
    "It finishes the requests in progress and takes no new ones. Ask another instance, or this one "
    "after Retry-After.",
)
NOT_READY: Final = ProblemType(
    "not-ready",
    503,
    "The service is not ready",
    "It is starting, or its default model is not usable; GET /models says why. Retry-After says "
    "when to ask again.",
)
MODEL_UNAVAILABLE: Final = ProblemType(
    "model-unavailable",
    503,
    "This model is not usable",
    "The version is in the store but was refused when it was loaded; GET /models says why. Other "
    "models answer.",
)
INTERNAL_ERROR: Final = ProblemType(
    "internal-error",
    500,
    "The service failed",
    "This is a defect of the service. Its log has the details under the request id.",
)

UPGRADE_REQUIRED: Final = ProblemType(
    "upgrade-required",
    426,
    "This address is for WebSockets",
    "GET /stream opens a WebSocket of version 13, whose handshake is the first request of its "
    "connection, or comes after the answers to all before. docs/stream.md says how it goes on.",
)
TOO_MANY_STREAMS: Final = ProblemType(
    "too-many-streams",
    503,
    "Too many streams are open",
    "The process has as many streams as SCENE_MAX_STREAMS allows. Retry-After says when to ask "
    "again; POST answers meanwhile.",
)

PROBLEM_TYPES: Final[dict[str, ProblemType]] = {
    kind.slug: kind
    for kind in (
        NOT_JSON,
        BAD_REQUEST,
        UNAUTHORIZED,
        ORIGIN_REFUSED,
        NOT_FOUND,
        MODEL_NOT_FOUND,
        METHOD_NOT_ALLOWED,
        REQUEST_TIMEOUT,
        ALIAS_CONFLICT,
        MODEL_UNUSABLE,
        REFRESH_REFUSED,
        STORE_NOT_WRITABLE,
        STORE_BUSY,
        BODY_TOO_LARGE,
        UNSUPPORTED_MEDIA_TYPE,
        INVALID_REQUEST,
        UNKNOWN_LABELS,
        CONTRADICTORY_EVIDENCE,
        ANSWER_TOO_LARGE,
        HOST_REFUSED,
        BODIES_FULL,
        INTERNAL_ERROR,
        NOT_READY,
        MODEL_UNAVAILABLE,
        DRAINING,
        QUEUE_FULL,
        DEADLINE_PASSED,
        UPGRADE_REQUIRED,
        TOO_MANY_STREAMS,
    )
}
