"""What a client is made with, checked once."""

from __future__ import annotations

import ssl
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import httpx

from scene_client.calls import Call, T
from scene_client.errors import InvalidRequestError
from scene_client.exchange import MAX_TIMEOUT, RETRIES, Lost
from scene_client.schemas import FieldError


@dataclass(frozen=True, slots=True)
class Options:
    """Where the service is, and how it is asked.

    Attributes:
        url: of the service, with the path that a proxy strips, if there is one.
        timeout: seconds for a whole call, further attempts and the pauses between them included.
        api_key, admin_key: where the service asks for them.
        model: asked where a request names none.
        retries: further attempts at most, as far as there is time for them.

    Raises:
        InvalidRequestError: there is no service at such a URL, or no call takes so long.
    """

    url: str
    timeout: float = 10.0
    api_key: str | None = field(default=None, repr=False)
    admin_key: str | None = field(default=None, repr=False)
    model: str | None = None
    retries: int = RETRIES

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise _refused("the URL must begin with http:// or https:// and name a host")
        if parts.query or parts.fragment:
            raise _refused("the URL must end with its path")
        if self.retries < 0:
            raise _refused("retries must not be negative")
        self.limit(self.timeout)

    def limit(self, timeout: float | None) -> float:
        """The seconds that a call may take.

        Raises:
            InvalidRequestError: no call takes so long, or so little.
        """
        seconds = self.timeout if timeout is None else timeout
        if not 1e-3 <= seconds <= MAX_TIMEOUT:
            raise _refused(f"the timeout must be from 0.001 to {MAX_TIMEOUT:g} seconds")
        return seconds

    def ssl_context(self) -> ssl.SSLContext:
        """Trusted certificates: the system's bundle; none without encryption."""
        if urlsplit(self.url).scheme == "https":
            return httpx.create_ssl_context()
        # Reading the bundle takes longer than a question.
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)

    def named(self, model: str | None) -> str:
        """The named model, else that of the options, else the default."""
        return model or self.model or "default"

    def address(self, call: Call[T]) -> str:
        """The URL of a call."""
        return self.url.rstrip("/") + call.path

    def lost(self, error: Exception, *, sent: bool) -> Lost:
        """The outcome of a call that got no answer for such a reason.

        Args:
            sent: the service may have got it.
        """
        parts = urlsplit(self.url)
        # A name and a password may stand before the host.
        host = parts.netloc.rpartition("@")[2]
        return Lost(f"{parts.scheme}://{host}: {str(error) or type(error).__name__}", sent=sent)

    def headers(self, call: Call[T]) -> dict[str, str]:
        """The headers of a call."""
        # Not compressed: a small compressed body could unpack to any size.
        headers = {"Accept": "application/json", "Accept-Encoding": "identity"}
        if call.body is not None:
            headers["Content-Type"] = "application/json"
        # The admin key is sent to administrative routes only.
        if call.administers and self.admin_key is not None:
            headers["X-Admin-Key"] = self.admin_key
        elif self.api_key is not None:
            headers["X-API-Key"] = self.api_key
        return headers


def _refused(message: str) -> InvalidRequestError:
    return InvalidRequestError([FieldError(pointer="#", message=message)])
