"""The settings of the service, read from environment variables with the prefix ``SCENE_``."""

import os
import re
import sys
from difflib import get_close_matches
from importlib import import_module
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from socket import gethostname
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SecretStr,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError
from pydantic_settings import BaseSettings, EnvSettingsSource, NoDecode, SettingsConfigDict
from pydantic_settings import PydanticBaseSettingsSource as Source

from scene_client.schemas import MAX_RELATIONS

_EXPORTER = "opentelemetry.exporter.otlp.proto.http"
_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")

_PREFIX: Final = "SCENE_"
# Variables of the clients, which may run in the same environment.
_OF_CLIENTS: Final = ("URL",)
_WITHOUT_USE: Final = {
    "ADMIN_KEY": "the service is administered with `python -m app.registry`, which needs no key"
}
# Kubernetes sets such variables in each pod, for every Service whose name starts with `scene`.
_SERVICE_LINK: Final = re.compile(
    r"(\w+_)?SERVICE_(HOST|PORT(_\w+)?)=.*|(\w+_)?PORT_\d+_(TCP|UDP|SCTP)(_\w+)?=.*"
    r"|\w+_PORT=(tcp|udp|sctp)://.*"
)


def _lower(value: object) -> object:
    return value.strip().lower() if isinstance(value, str) else value


def _words(value: object) -> object:
    return tuple(value.replace(",", " ").split()) if isinstance(value, str) else value


_Words = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_words)]

_HOST: Final = re.compile(r"[a-z0-9_]([a-z0-9._-]*[a-z0-9_])?")


def _host(text: str) -> str:
    """Return a host name in lower case, or an IP address without brackets. Else: ValueError."""
    name = text.lower()
    if _HOST.fullmatch(name):
        return name
    return str(IPv6Address(name[1:-1] if name.startswith("[") and name.endswith("]") else name))


def _names_of_this_machine() -> set[str]:
    """Return the host names of this machine, including the one of multicast DNS (`.local`)."""
    name = gethostname().lower()
    names = {"localhost", name, f"{name.partition('.')[0]}.local"}
    return {name for name in names if _HOST.fullmatch(name)}


# What a browser can send as the Origin header, but for default ports.
_ORIGIN: Final = re.compile(r"https?://([a-z0-9_.-]+|\[[0-9a-f:.]+\])(:[1-9][0-9]{0,4})?")
_DEFAULT_PORT: Final = re.compile(r"http:.*:80|https:.*:443")


class _Environment(EnvSettingsSource):
    """The environment variables of the service. Unknown names are errors."""

    def __call__(self) -> dict[str, Any]:
        """Return the settings in the environment. Unknown ones raise pydantic.ValidationError."""
        names = [name.upper() for name in self.settings_cls.model_fields]
        accepted = {*names, *_OF_CLIENTS, *_WITHOUT_USE}
        errors: list[InitErrorDetails] = []
        for variable, value in sorted(os.environ.items()):
            name = variable.upper().removeprefix(_PREFIX)
            if name == variable.upper() or not value or name in accepted:
                continue
            if _SERVICE_LINK.fullmatch(f"{name}={value}"[:256]):
                continue
            message = "unknown setting; docs/operations.md lists the settings"
            if similar := get_close_matches(name, names, 1):
                message = f"unknown setting; did you mean {_PREFIX}{similar[0]}?"
            kind = PydanticCustomError("unknown_setting", "{message}", {"message": message})
            errors.append({"type": kind, "loc": (name.lower(),), "input": None})
        if errors:
            raise ValidationError.from_exception_data("Settings", errors)
        return super().__call__()


def warnings() -> list[str]:
    """Return a warning for each set environment variable that the service no longer uses."""
    return [
        f"{_PREFIX}{name} has no effect: {reason}"
        for name, reason in _WITHOUT_USE.items()
        if os.environ.get(_PREFIX + name)
    ]


class Settings(BaseSettings):
    """The settings of the service.

    Raises:
        pydantic.ValidationError: a value is invalid. Each message names the environment variable.
    """

    model_config = SettingsConfigDict(
        env_prefix=_PREFIX,
        env_ignore_empty=True,
        frozen=True,
        extra="forbid",
        validate_default=True,
        hide_input_in_errors=True,
    )
    reads_environment: ClassVar[bool] = True

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """Port to listen on; 0 = any free port."""
    health_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Further port, which answers only health checks, however busy the service is; none by
    default."""
    store: Path = Path("model_store")
    """Folder of published models."""
    store_poll: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = 5
    """Seconds between two checks of the store for changes; 0 = never."""
    api_key: SecretStr | None = None
    """Key of all routes except health checks and pages, at least 16 characters; without a key,
    these routes are open."""
    recording: Path | None = None
    """File `*.jsonl` to which POST /confirm appends; without it or without a key, there is no such
    route. For one replica."""
    cors_origins: _Words = ()
    """Web origins whose pages may use the service, separated by commas, such as
    `https://panel.example:8443`; none by default."""
    allowed_hosts: _Words = ()
    """Host names that clients may use for this service, separated by commas, without ports; `*`
    allows all; default: the names of this machine. Every IP address is allowed."""
    trusted_proxies: _Words = ()
    """Addresses of proxies, separated by commas, whose X-Forwarded-For header names the client; `*`
    trusts every address; none by default."""
    max_connections: Annotated[int, Field(ge=1, le=2**20)] = 1024
    """Number of connections from which the service answers every request with 503."""
    max_body_bytes: Annotated[int, Field(ge=1024, le=64 * 2**20)] = 2 * 2**20
    """Maximum size of a request body in bytes."""
    max_scene_bytes: Annotated[int, Field(ge=1024, le=64 * 2**20)] = 256 * 2**10
    """Maximum size in bytes of the body of a question about one scene; a home may have twice as
    much."""
    held_body_bytes: Annotated[int, Field(ge=2**20, le=2**36)] = 64 * 2**20
    """Maximum total size in bytes of the bodies of all requests and large answers in progress; one
    client holds at most a quarter."""
    max_objects: Annotated[int, Field(ge=1, le=256)] = 256
    """Maximum number of objects in a scene."""
    max_relations: Annotated[int, Field(ge=0, le=MAX_RELATIONS)] = 4096
    """Maximum number of stated relations in a scene."""
    max_answer_bytes: Annotated[int, Field(ge=2**16, le=2**30)] = 4 * 2**20
    """Maximum size of an answer in bytes."""
    max_weights_bytes: Annotated[int, Field(ge=1024, le=2**40)] = 2**30
    """Maximum size of a weights file in bytes."""
    queue_rows: Annotated[int, Field(ge=1024, le=2**20)] = 4096
    """Maximum number of scenes of batches and large requests that wait or are being computed; one
    client holds at most a quarter."""
    queue_requests: Annotated[int, Field(ge=4, le=2**20)] = 1024
    """Maximum number of requests that wait for their turn; one client holds at most a quarter."""
    request_timeout_ms: Annotated[int, Field(ge=1, le=600_000)] = 10_000
    """Time limit in milliseconds of a request without X-Request-Timeout-Ms."""
    max_request_timeout_ms: Annotated[int, Field(ge=1, le=600_000)] = 60_000
    """Maximum time limit in milliseconds that a client may choose."""
    drain_seconds: Annotated[float, Field(ge=0, le=300)] = 4.0
    """Seconds from SIGTERM until the listening socket closes. The readiness check fails in this
    time, and requests are still answered."""
    drain_timeout: Annotated[int, Field(ge=1, le=3600)] = 25
    """Maximum seconds for requests in progress after the socket closes."""
    client_timeout: Annotated[float, Field(ge=0.1, le=3600, allow_inf_nan=False)] = 20
    """Seconds that a client may take to send a request body, and to acknowledge an answer."""
    retry_after: Annotated[int, Field(ge=1, le=3600)] = 2
    """Seconds in the Retry-After header of responses 429 and 503."""
    metrics: bool = True
    """Answer GET /metrics."""
    opentelemetry: bool = False
    """Send traces to the collector in OTEL_EXPORTER_OTLP_ENDPOINT."""
    docs: bool = True
    """Serve the scene editor, /docs, /redoc and /openapi.json."""
    root_path: Annotated[str, Field(pattern=r"^(/[^/?#]+)*$")] = ""
    """Path prefix that a reverse proxy strips."""
    log_level: Annotated[
        Literal["debug", "info", "warning", "error", "critical"], BeforeValidator(_lower)
    ] = "info"
    log_format: Annotated[Literal["json", "plain"], BeforeValidator(_lower)] = Field(
        default_factory=lambda: "plain" if sys.stderr.isatty() else "json"
    )
    """By default, `plain` on a terminal, else `json`."""
    access_log: bool = True
    """Log one line per request, without payload."""

    @classmethod
    def settings_customise_sources(
        cls, settings_cls: type[BaseSettings], init_settings: Source, *_: Source, **__: Source
    ) -> tuple[Source, ...]:
        """Return the sources of the settings: first arguments, then environment variables."""
        if not cls.reads_environment:
            return (init_settings,)
        return init_settings, _Environment(settings_cls)

    @property
    def accepted_hosts(self) -> frozenset[str] | None:
        """Accepted names in a Host header, without ports, or None if every name is accepted."""
        if "*" in self.allowed_hosts:
            return None
        return frozenset(self.allowed_hosts or (*_names_of_this_machine(), self.host))

    @property
    def serves_network(self) -> bool:
        """Whether other machines can reach the service."""
        try:
            return not ip_address(self.host).is_loopback
        except ValueError:  # the host is a name, not an address
            return self.host != "localhost"

    @field_validator("host")
    @classmethod
    def _check_host(cls, value: str) -> str:
        try:
            return _host(value)
        except ValueError:
            raise ValueError("SCENE_HOST must be a name or an IP address") from None

    @field_validator("health_port")
    @classmethod
    def _check_health_port(cls, value: int | None, info: ValidationInfo) -> int | None:
        if value is not None and value == info.data.get("port"):
            raise ValueError("it must differ from SCENE_PORT")
        return value

    @field_validator("allowed_hosts")
    @classmethod
    def _check_allowed_hosts(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return tuple(name if name == "*" else _host(name) for name in value)
        except ValueError:
            raise ValueError(
                "SCENE_ALLOWED_HOSTS must be * or a list of names; a name must not contain a "
                "scheme, a port or a wildcard"
            ) from None

    @field_validator("store")
    @classmethod
    def _check_store(cls, value: Path) -> Path:
        if not value.is_dir():
            raise ValueError(f"SCENE_STORE must be an existing directory, but is {value}")
        return value

    @field_validator("recording")
    @classmethod
    def _check_recording(cls, value: Path | None) -> Path | None:
        if value is not None and (value.suffix != ".jsonl" or not value.parent.is_dir()):
            raise ValueError(
                "SCENE_RECORDING must be a file *.jsonl in an existing directory, such as "
                "/var/lib/scene/scenes.jsonl"
            )
        return value

    @field_validator("max_request_timeout_ms")
    @classmethod
    def _check_longest_timeout(cls, value: int, info: ValidationInfo) -> int:
        if value < info.data.get("request_timeout_ms", 0):
            raise ValueError("it must be at least SCENE_REQUEST_TIMEOUT_MS")
        return value

    @field_validator("opentelemetry")
    @classmethod
    def _check_telemetry(cls, value: bool) -> bool:
        if not value:
            return value
        try:
            import_module(_EXPORTER)
        except ImportError:
            raise ValueError("SCENE_OPENTELEMETRY needs pip install '.[telemetry]'") from None
        # Without the URL of a collector, the service would start but never send a trace.
        if not any(map(os.environ.get, _ENDPOINTS)):
            raise ValueError(f"SCENE_OPENTELEMETRY needs {_ENDPOINTS[0]}, the URL of a collector")
        return value

    @field_validator("api_key")
    @classmethod
    def _check_api_key(cls, value: SecretStr | None) -> SecretStr | None:
        if value is None:
            return None
        key = value.get_secret_value()
        # The key must be valid in an HTTP header. An attacker could guess a short key.
        if len(key) < 16 or not (key.isascii() and key.isprintable()) or " " in key:
            raise ValueError(
                "SCENE_API_KEY must have at least 16 printable ASCII characters, without spaces"
            )
        return value

    @field_validator("cors_origins")
    @classmethod
    def _check_cors_origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not all(map(_ORIGIN.fullmatch, value)) or any(map(_DEFAULT_PORT.fullmatch, value)):
            raise ValueError(
                "SCENE_CORS_ORIGINS must list origins as browsers send them: http or https, a host "
                "in lower case, a port other than the default port, and no path or wildcard"
            )
        return value
