"""The problem types (RFC 9457) of the service. Each has a name, a status, a title and a remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class ProblemType:
    """A problem type (RFC 9457).

    Attributes:
        slug: stable name and last path segment of the ``type`` member. Clients can compare it.
        status: HTTP status code.
        title: short summary. All problems of this type have the same title.
        explanation: cause and remedy. The page of the problem type shows this text.
    """

    slug: str
    status: int
    title: str
    explanation: str

    @property
    def uri(self) -> str:
        """The ``type`` member of the problem document (RFC 9457, section 3.1.1)."""
        return f"/problems/{self.slug}"


NOT_JSON: Final = ProblemType(
    "not-json",
    400,
    "The body is not acceptable JSON",
    "The body must be one JSON value in UTF-8 without a byte order mark. The service refuses NaN, "
    "Infinity, lone surrogates, duplicate member names in an object and nesting deeper than 200. "
    "JSON parsers read such texts in different ways. In a body of at most 64 KiB, `errors` points "
    "at each NaN and Infinity.",
)
BAD_REQUEST: Final = ProblemType(
    "bad-request",
    400,
    "The request could not be read",
    "Either the connection closed before the body was complete, or X-Request-Timeout-Ms is "
    "invalid. This header must be a whole number of milliseconds, from 1 to "
    "SCENE_MAX_REQUEST_TIMEOUT_MS.",
)
UNAUTHORIZED: Final = ProblemType(
    "unauthorized",
    401,
    "A valid key is required",
    "Administration routes need the admin key in the header X-Admin-Key or Authorization: Bearer. "
    "If SCENE_ADMIN_KEY is not set, the service refuses every administration request. If "
    "SCENE_API_KEY is set, all other routes need that key in the header X-API-Key or "
    "Authorization: Bearer. Health checks and HTML pages need no key.",
)
ORIGIN_REFUSED: Final = ProblemType(
    "origin-refused",
    403,
    "Pages of this origin may not send this request",
    "A browser asked whether a page of another origin may send a request. SCENE_CORS_ORIGINS lists "
    "the allowed origins. Pages of these origins may ask questions and read the models. They may "
    "not administer the service.",
)
NOT_FOUND: Final = ProblemType(
    "not-found",
    404,
    "The service has no route at this path",
    "/openapi.json lists the routes, unless SCENE_DOCS is off.",
)
MODEL_NOT_FOUND: Final = ProblemType(
    "model-not-found",
    404,
    "The model or version does not exist",
    "Name a model by an alias, by its name or as name@version. A name selects the newest usable "
    "version. GET /models lists all models, versions and aliases.",
)
METHOD_NOT_ALLOWED: Final = ProblemType(
    "method-not-allowed",
    405,
    "This route does not accept this method",
    "The Allow header lists the methods of the route.",
)
REQUEST_TIMEOUT: Final = ProblemType(
    "request-timeout",
    408,
    "The request did not arrive in time",
    "The body of a request must arrive within SCENE_CLIENT_TIMEOUT seconds after its headers. "
    "The service closes the connection. Send the request again on a new connection.",
)
ALIAS_CONFLICT: Final = ProblemType(
    "alias-conflict",
    409,
    "The alias does not point to the expected version",
    "Another client has moved the alias. GET /models shows its new target. Send the request again "
    "with this target as `expected`. An alias cannot have the name of a model either.",
)
MODEL_UNUSABLE: Final = ProblemType(
    "model-unusable",
    409,
    "An alias cannot point to this version",
    "The version is in the store, but the service refused to load it. GET /models gives the "
    "reason.",
)
REFRESH_REFUSED: Final = ProblemType(
    "refresh-refused",
    409,
    "The new state of the store was refused",
    "A version in the store failed its verification or its warm-up, or the target of an alias is "
    "not usable. The service still serves the previous versions. "
    "`failures` lists each refused version or alias with the reason.",
)
STORE_NOT_WRITABLE: Final = ProblemType(
    "store-not-writable",
    409,
    "The store cannot be written",
    "Either this service has no write access to the store, which holds the aliases, or the table "
    "of aliases is full. Without write access, change the alias on a computer that has it. Then "
    "send POST /models/refresh to this service.",
)
STORE_BUSY: Final = ProblemType(
    "store-busy",
    503,
    "Another process is writing to the store",
    "That process holds the lock of the store, for example while it publishes a version. "
    "Send the request again after the time in Retry-After.",
)
BODY_TOO_LARGE: Final = ProblemType(
    "body-too-large",
    413,
    "The body is too large",
    "Send fewer scenes in one request. SCENE_MAX_SCENE_BYTES limits the body of a question about "
    "one scene, and SCENE_MAX_BODY_BYTES all bodies. Both limits also apply to chunked bodies.",
)
UNSUPPORTED_MEDIA_TYPE: Final = ProblemType(
    "unsupported-media-type",
    415,
    "The body is not declared as JSON",
    "Send Content-Type: application/json, without a charset other than utf-8 and without "
    "Content-Encoding.",
)
INVALID_REQUEST: Final = ProblemType(
    "invalid-request",
    422,
    "The request is not valid for this route",
    "The body is JSON, but does not match the schema of this route. `errors` lists the errors. "
    "The `pointer` of an error is a JSON pointer into the body. `suggestions` lists the nearest "
    "valid names.",
)
UNKNOWN_LABELS: Final = ProblemType(
    "unknown-labels",
    422,
    "The model does not know some labels or room types",
    "`errors` points at each unknown name and suggests the nearest known ones. With "
    "`unknown_labels` set to `ignore`, the service ignores unknown labels and lists them in "
    "`ignored`. With `nearest`, it maps misspelt labels and phrases to a class and lists them in "
    "`mapped`. It refuses a label that could be several classes. With `nearest-or-ignore`, it "
    "ignores such a label. GET /models/{name}/vocabulary lists every known label.",
)
CONTRADICTORY_EVIDENCE: Final = ProblemType(
    "contradictory-evidence",
    422,
    "The scene contradicts itself",
    "Either an object has a relation to itself, or a pair has both a relation and its opposite "
    "(left and right, on-top and under).",
)
ANSWER_TOO_LARGE: Final = ProblemType(
    "answer-too-large",
    422,
    "The answer would be too large",
    "The answer would exceed SCENE_MAX_ANSWER_BYTES. `errors` points at the parameter to lower: "
    "`top_k`, `count` or the number of `objects`. Shorter ids also make the answer smaller. All "
    "scenes of a batch share one limit. Send the refused scenes in another request.",
)
HOST_REFUSED: Final = ProblemType(
    "host-refused",
    421,
    "The service does not answer to this host name",
    "The Host header must be one of the names in SCENE_ALLOWED_HOSTS. The service ignores the port "
    "in this header. The default names are 127.0.0.1, localhost, [::1] and the address in "
    "SCENE_HOST. Add the name that your clients use. Health checks answer to every host name.",
)
BODIES_FULL: Final = ProblemType(
    "bodies-full",
    503,
    "The service holds too many bytes of request bodies",
    "All requests in progress share SCENE_HELD_BODY_BYTES for their bodies. The service always "
    "accepts a body of at most 64 KiB that has arrived whole. Send the request again after the "
    "time in Retry-After.",
)
INTERNAL_ERROR: Final = ProblemType(
    "internal-error",
    500,
    "The service failed",
    "This is a defect of the service. Search the log of the service for the request id to find the "
    "details.",
)
NOT_READY: Final = ProblemType(
    "not-ready",
    503,
    "The service is not ready",
    "Either the service is still starting, or its default model is not usable. GET /models gives "
    "the reason. Send the request again after the time in Retry-After.",
)
MODEL_UNAVAILABLE: Final = ProblemType(
    "model-unavailable",
    503,
    "This model is not usable",
    "The version is in the store, but the service refused to load it. GET /models gives the "
    "reason. Other models may still be usable.",
)
DRAINING: Final = ProblemType(
    "draining",
    503,
    "The service is shutting down",
    "The service soon closes its socket. Use another instance, or send the request again after the "
    "time in Retry-After.",
)
QUEUE_FULL: Final = ProblemType(
    "queue-full",
    429,
    "Too many requests are waiting",
    "The queue of requests (SCENE_QUEUE_REQUESTS) or the queue of this model's scenes "
    "(SCENE_QUEUE_ROWS) is full. The service also refuses a request that would wait in the queue "
    "for too much of its time limit. The service did not start the computation. Send the request "
    "again after the time in Retry-After.",
)
DEADLINE_PASSED: Final = ProblemType(
    "deadline-passed",
    504,
    "The deadline passed",
    "The answer was not complete within the time limit of the request. X-Request-Timeout-Ms sets "
    "this limit. The default is SCENE_REQUEST_TIMEOUT_MS. The service has stopped the computation.",
)

PROBLEM_TYPES: Final = {
    kind.slug: kind for kind in tuple(vars().values()) if isinstance(kind, ProblemType)
}
"""All problem types by slug, in the order of this module."""
