"""Every knob of the service, typed, read from the environment (prefix ``SCENE_``)."""

from __future__ import annotations

import os
import re
from importlib.util import find_spec
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from typing import Annotated, Final, Literal
from urllib.parse import urlsplit

from pydantic import BeforeValidator, Field, SecretStr, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from scene_client.schemas import MAX_RELATIONS

MAX_OBJECTS = 256
"""The contract's limit on objects in one scene; settings may lower it, never raise it."""


_EXPORTER = ("opentelemetry.sdk.trace", "opentelemetry.exporter.otlp.proto.http")
_ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # a package above it is missing already
        return False


def _lower(value: object) -> object:
    return value.strip().lower() if isinstance(value, str) else value


def _words(value: object) -> object:
    return tuple(value.replace(",", " ").split()) if isinstance(value, str) else value


LOOPBACK: Final = frozenset(("127.0.0.1", "localhost", "[::1]"))
"""Names of this machine in a Host header."""

_ANY_HOST: Final = "*"
_HOST: Final = re.compile(r"[a-z0-9_]([a-z0-9._-]*[a-z0-9_])?")


def _in_host_header(text: str) -> str:
    """A name or an address as it stands in a Host header.

    Raises:
        ValueError: it is neither.
    """
    name = text.lower()
    if _HOST.fullmatch(name):
        return name
    return f"[{IPv6Address(name.removeprefix('[').removesuffix(']'))}]"


def _is_origin(text: str) -> bool:
    """Whether a browser would send this text, to the letter, as the origin of a page."""
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        return False
    if parts.scheme not in {"http", "https"} or not parts.hostname or "*" in parts.hostname:
        return False
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    usual = {"http": 80, "https": 443}[parts.scheme]
    return text == f"{parts.scheme}://{host}" + ("" if port in {None, usual} else f":{port}")


class Settings(BaseSettings):
    """What an operator may choose. The defaults are safe: loopback only, no admin routes.

    Raises:
        pydantic.ValidationError: a value makes no sense; every message names its variable.
    """

    model_config = SettingsConfigDict(
        env_prefix="SCENE_",
        env_ignore_empty=True,
        frozen=True,
        extra="forbid",
        validate_default=True,
        hide_input_in_errors=True,
    )

    host: Annotated[str, Field(min_length=1, description="address to listen on")] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535, description="0 = any free port")] = 8000
    store: Annotated[Path, Field(description="directory of published models")] = Path("model_store")
    store_poll: Annotated[
        float,
        Field(
            ge=0,
            le=3600,
            allow_inf_nan=False,
            description="seconds between two looks for changes of the store; 0 = never",
        ),
    ] = 5
    admin_key: Annotated[
        SecretStr | None,
        Field(
            description="key of the admin routes, at least 16 characters; without it they are off"
        ),
    ] = None
    api_key: Annotated[
        SecretStr | None,
        Field(
            description="key of every route but health and pages, at least 16 characters and not "
            "the admin key; without it those routes are open"
        ),
    ] = None
    cors_origins: Annotated[
        tuple[str, ...],
        NoDecode,
        BeforeValidator(_words),
        Field(
            description="origins whose pages a browser lets read answers, as in "
            "`https://panel.example:8443`, parted by commas; none by default"
        ),
    ] = ()
    allowed_hosts: Annotated[
        tuple[str, ...],
        NoDecode,
        BeforeValidator(_words),
        Field(
            description="names and addresses that clients may use for this service, parted by "
            "commas and without ports; `*` allows all; by default those of this machine, and "
            "SCENE_HOST where that is one address"
        ),
    ] = ()
    max_connections: Annotated[
        int,
        Field(ge=1, le=2**20, description="connections from which on requests get a plain 503"),
    ] = 1024
    max_body_bytes: Annotated[
        int, Field(ge=1024, le=64 * 2**20, description="largest request body")
    ] = 2 * 2**20
    held_body_bytes: Annotated[
        int,
        Field(ge=2**20, le=2**36, description="bytes of all request bodies that are held at once"),
    ] = 64 * 2**20
    max_objects: Annotated[
        int, Field(ge=1, le=MAX_OBJECTS, description="most objects in one scene")
    ] = MAX_OBJECTS
    max_relations: Annotated[
        int, Field(ge=0, le=MAX_RELATIONS, description="most relations given in one scene")
    ] = 4096
    max_answer_bytes: Annotated[
        int, Field(ge=2**16, le=2**30, description="largest answer to one request")
    ] = 16 * 2**20
    max_weights_bytes: Annotated[
        int, Field(ge=1024, le=2**40, description="largest weights file of a version")
    ] = 2**30
    queue_rows: Annotated[
        int,
        Field(
            ge=256,
            le=2**20,
            description="most scenes that wait for a model, or are under way there",
        ),
    ] = 4096
    queue_requests: Annotated[
        int, Field(ge=1, le=2**20, description="most requests that wait to be read")
    ] = 256
    request_timeout_ms: Annotated[
        int,
        Field(ge=1, le=600_000, description="of requests that send no X-Request-Timeout-Ms"),
    ] = 10_000
    max_request_timeout_ms: Annotated[
        int,
        Field(ge=1, le=600_000, description="longest deadline that a client may choose"),
    ] = 60_000
    max_streams: Annotated[
        int, Field(ge=0, le=4096, description="most streams a process has at once")
    ] = 64
    stream_idle: Annotated[
        float,
        Field(
            ge=1,
            le=86_400,
            allow_inf_nan=False,
            description="seconds a stream may be silent",
        ),
    ] = 300
    drain_seconds: Annotated[
        float,
        Field(ge=0, le=300, description="from SIGTERM until the listening socket is closed"),
    ] = 1.0
    drain_timeout: Annotated[
        int, Field(ge=1, le=3600, description="seconds that work under way may take after that")
    ] = 25
    client_timeout: Annotated[
        float,
        Field(
            ge=0.1,
            le=3600,
            allow_inf_nan=False,
            description="seconds a client may take to send a request's body, to acknowledge what "
            "it is sent, and to answer a stream's pings",
        ),
    ] = 20
    retry_after: Annotated[
        int, Field(ge=1, le=3600, description="seconds named in Retry-After when not ready")
    ] = 2
    metrics: Annotated[bool, Field(description="answer GET /metrics")] = True
    opentelemetry: Annotated[
        bool, Field(description="send traces to where OTEL_EXPORTER_OTLP_ENDPOINT says")
    ] = False
    docs: Annotated[
        bool, Field(description="serve the visual page, /docs, /redoc and /openapi.json")
    ] = True
    root_path: Annotated[
        str, Field(description="path prefix that a reverse proxy strips", pattern=r"^(/[^/?#]+)*$")
    ] = ""
    log_level: Annotated[
        Literal["debug", "info", "warning", "error", "critical"], BeforeValidator(_lower)
    ] = "info"
    log_format: Annotated[Literal["json", "plain"], BeforeValidator(_lower)] = "json"
    access_log: Annotated[bool, Field(description="one line a request, never its payload")] = True

    @property
    def secrets(self) -> list[str]:
        """What no log may hold."""
        return [key.get_secret_value() for key in (self.admin_key, self.api_key) if key]

    @property
    def accepted_hosts(self) -> frozenset[str] | None:
        """What a Host header may name, without the port; None where it may name anything."""
        if _ANY_HOST in self.allowed_hosts:
            return None
        if self.allowed_hosts:
            return frozenset(self.allowed_hosts)
        return LOOPBACK if self._listens_everywhere else LOOPBACK | {_in_host_header(self.host)}

    @property
    def is_open(self) -> bool:
        """Whether other machines may ask without a key."""
        is_local = self.host.startswith("127.") or self.host in {"localhost", "::1"}
        return self.api_key is None and not is_local

    @property
    def _listens_everywhere(self) -> bool:
        try:
            return ip_address(self.host).is_unspecified
        except ValueError:  # a name
            return False

    @field_validator("host")
    @classmethod
    def _is_host(cls, value: str) -> str:
        try:
            _in_host_header(value)
        except ValueError:
            raise ValueError("SCENE_HOST must be an address or a name") from None
        return value

    @field_validator("allowed_hosts")
    @classmethod
    def _are_hosts(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return tuple(name if name == _ANY_HOST else _in_host_header(name) for name in value)
        except ValueError:
            raise ValueError(
                "SCENE_ALLOWED_HOSTS must list names and addresses without scheme, port and "
                "wildcard, or be *"
            ) from None

    @field_validator("store")
    @classmethod
    def _is_directory(cls, value: Path) -> Path:
        if not value.is_dir():
            raise ValueError(f"SCENE_STORE must be an existing directory, and {value} is none")
        return value

    @field_validator("max_request_timeout_ms")
    @classmethod
    def _covers_the_default(cls, value: int, info: ValidationInfo) -> int:
        if value < info.data.get("request_timeout_ms", 0):
            raise ValueError(
                "SCENE_MAX_REQUEST_TIMEOUT_MS must not be below SCENE_REQUEST_TIMEOUT_MS"
            )
        return value

    @field_validator("opentelemetry")
    @classmethod
    def _can_export(cls, value: bool) -> bool:
        if not value:
            return value
        if not all(map(_is_installed, _EXPORTER)):
            raise ValueError(
                "SCENE_OPENTELEMETRY needs the packages of the dependency group telemetry "
                "(pip install '.[telemetry]')"
            )
        # The framework would start without one and send nothing.
        if not any(map(os.environ.get, _ENDPOINTS)):
            raise ValueError(f"SCENE_OPENTELEMETRY needs {_ENDPOINTS[0]}, the collector's URL")
        return value

    @field_validator("admin_key", "api_key")
    @classmethod
    def _is_strong(cls, value: SecretStr | None, info: ValidationInfo) -> SecretStr | None:
        if value is None:
            return None
        key = value.get_secret_value()
        # The key travels in a header, so it must survive one; a short one can be tried out.
        if len(key) < 16 or not (key.isascii() and key.isprintable()) or " " in key:
            raise ValueError(
                f"SCENE_{str(info.field_name).upper()} must have at least 16 printable ASCII "
                "characters and no space"
            )
        return value

    @field_validator("api_key")
    @classmethod
    def _is_not_the_admin_key(
        cls, value: SecretStr | None, info: ValidationInfo
    ) -> SecretStr | None:
        if value is not None and value == info.data.get("admin_key"):
            raise ValueError(
                "SCENE_API_KEY must differ from SCENE_ADMIN_KEY: clients are not administrators"
            )
        return value

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not all(map(_is_origin, value)):
            raise ValueError(
                "SCENE_CORS_ORIGINS must list origins as browsers send them: http or https, host "
                "in lower case, port where it is not the usual one, no path and no wildcard"
            )
        return value
