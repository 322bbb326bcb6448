"""Settings: safe defaults, and messages about invalid values."""

import json
import logging
import os
import re
import sys
from datetime import datetime
from pathlib import Path
from typing import Literal

import pytest
from pydantic import ValidationError

from app.__main__ import main
from app.serving.logs import Masked
from app.settings import Settings
from tests.conftest import run_program


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("SCENE_"):
            monkeypatch.delenv(name)


def test_settings_of_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_STORE", str(tmp_path))
    monkeypatch.setenv("SCENE_PORT", "9000")
    monkeypatch.setenv("SCENE_API_KEY", "0123456789abcdef")
    monkeypatch.setenv("SCENE_LOG_LEVEL", "DEBUG")
    monkeypatch.setenv("SCENE_CORS_ORIGINS", "https://panel.example, http://[::1]:3000")
    settings = Settings()
    assert settings.store == tmp_path
    assert settings.cors_origins == ("https://panel.example", "http://[::1]:3000")
    assert settings.port == 9000
    assert settings.log_level == "debug"
    assert "0123456789abcdef" not in repr(settings)
    monkeypatch.setenv("SCENE_API_KEY", "")
    assert Settings().api_key is None


INVALID = {
    "host": ["", "http://127.0.0.1", "[::1", "127.0.0.1:8000"],
    "port": [-1, 65536, "tcp://10.0.0.1:80"],
    "health_port": [0, 65536, 8000],
    "store_poll": [-1, "nan", 3601],
    "store": ["no/such/directory", __file__],
    "api_key": ["too-short", "has spaces in between", "sixteen-chars-é-no"],
    "cors_origins": [
        *("*", "null", "https://*.example", "panel.example", "https://panel.example/"),
        *("https://panel.example/path", "https://Panel.example", "https://user@panel.example"),
        *("https://panel.example:443", "https://panel.example:port", "ftp://panel.example"),
        "https://good.example, https://bad.example/",
    ],
    "max_body_bytes": [0, 2**40],
    "max_objects": [0, 257],
    "max_relations": [-1],
    "retry_after": [0],
    "root_path": ["api/", "/api/"],
    "log_level": ["loud"],
    "log_format": ["xml"],
    "docs": ["maybe"],
    "metrics": ["some"],
    "opentelemetry": ["perhaps"],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in INVALID.items() for value in values]
)
def test_invalid_settings_are_refused(tmp_path: Path, name: str, value: object) -> None:
    with pytest.raises(ValidationError) as error:
        Settings(**{"store": tmp_path, name: value})
    (fault,) = error.value.errors()
    assert fault["loc"] == (name,)
    if name.endswith("_key"):
        assert str(value) not in str(error.value)
        assert f"SCENE_{name.upper()}" in fault["msg"]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("SCENE_STOER", "models", "unknown setting; did you mean SCENE_STORE?"),
        ("scene_max_object", "7", "unknown setting; did you mean SCENE_MAX_OBJECTS?"),
        ("SCENE_HTTP_PORT", "80", "unknown setting"),
        ("SCENE_ZZ", "1", "unknown setting; docs/operations.md lists the settings"),
        ("SCENE_PORT", "tcp://10.0.0.1:8000", "Input should be a valid integer"),
    ],
)
def test_unknown_names_stop_the_start(tmp_path, monkeypatch, capsys, name, value, message):
    monkeypatch.setenv("SCENE_STORE", str(tmp_path))
    monkeypatch.setenv(name, value)
    assert main([]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{name.upper()}: {message}")


def test_help_lists_the_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["--port", "9000"])
    refusal = "unknown arguments: --port 9000; settings are environment variables"
    assert refusal in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    shown = [line for line in lines if line and line[0].startswith("SCENE_")]
    names = [f"SCENE_{name.upper()}" for name in Settings.model_fields]
    assert [name for name, *_ in shown] == names
    assert ["SCENE_PORT", "8000"] in shown


OTHERS = (
    "SCENE_STOER= SCENE_URL=http://127.0.0.1 SCENE_SERVICE_HOST=10.0.0.1 SCENE_SERVICE_PORT=8000 "
    "SCENE_SERVICE_PORT_HTTP=8000 SCENE_PORT_8000_TCP=tcp://10.0.0.1:8000 "
    "SCENE_PORT_8000_TCP_ADDR=10.0.0.1 SCENE_HEADLESS_SERVICE_HOST=10.0.0.1 "
    "SCENE_HEADLESS_PORT=tcp://10.0.0.1:8000"
)
"""Variables of clients, and of Kubernetes for a service with the name scene."""


def test_other_variables_are_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in (f"SCENE_STORE={tmp_path}", *OTHERS.split()):
        monkeypatch.setenv(*variable.split("=", 1))
    assert Settings().port == 8000


@pytest.mark.system
def test_the_start_names_invalid_settings(tmp_path: Path) -> None:
    wrong = {
        "SCENE_STORE": str(tmp_path / "none"),
        "SCENE_PORT": "many",
        "SCENE_API_KEY": "a key that has spaces in it",
    }
    run = run_program(sys.executable, "-m", "app", status=2, env=os.environ | wrong)
    assert sorted(line.partition(":")[0] for line in run.stderr.splitlines()) == sorted(wrong)
    assert wrong["SCENE_API_KEY"] not in run.stdout + run.stderr


@pytest.mark.parametrize("style", ["json", "plain"])
def test_a_key_is_masked_in_any_spelling(style: Literal["json", "plain"]) -> None:
    secret = 'quote"and\\backslash'
    try:
        raise ValueError(secret)
    except ValueError:
        reason = sys.exc_info()
    record = logging.LogRecord("app", logging.ERROR, "file", 1, "it was %s", (secret,), reason)
    record.entry = {"note": secret}
    line = Masked(style, [secret]).format(record)
    assert "it was **********" in line
    assert "ValueError: **********" in line
    assert "backslash" not in line


def test_a_json_line_has_the_documented_fields() -> None:
    record = logging.LogRecord("app", logging.ERROR, "file", 1, "a \udc80", (), None)
    record.entry = {"request_id": "r1"}
    entry = json.loads(Masked("json").format(record))
    assert datetime.fromisoformat(entry.pop("time")).timestamp() == pytest.approx(record.created)
    assert entry.pop("message").startswith("a ")
    expected = {"level": "error", "process": record.process, "logger": "app", "request_id": "r1"}
    assert entry == expected


def in_words(name: str, default: object) -> str:
    """The default of a setting as docs/operations.md writes it."""
    if default is None or default in ((), ""):
        return "–"
    if isinstance(default, bool):
        return str(default).lower()
    if name.endswith("_bytes") and isinstance(default, int):
        power = (default.bit_length() - 1) // 10
        return f"{default // 2 ** (10 * power)} {('', 'Ki', 'Mi', 'Gi')[power]}B"
    return f"{default:g}" if isinstance(default, float) else str(default)


def test_the_documentation_lists_every_setting(repository: Path) -> None:
    pages = {page.name: page.read_text("utf-8") for page in (repository / "docs").glob("*.md")}
    row = re.compile(r"^\| `SCENE_([A-Z_]+)` \| ([^|]+) \| [^|]+ \|$", re.MULTILINE)
    rows = [(name, *found) for name, page in pages.items() for found in row.findall(page)]
    assert {page for page, _, _ in rows} == {"operations.md"}
    fields = Settings.model_fields.items()
    expected = {name.upper(): in_words(name, field.default) for name, field in fields}
    expected["LOG_FORMAT"] = "–"  # depends on the terminal
    assert {name: default.strip("`") for _, name, default in rows} == expected
    assert len(rows) == len(expected)
    text = pages["operations.md"].partition("Clients read these variables:\n\n")[2]
    listed = set(re.findall(r"^\| `(SCENE_[A-Z_]+)`", text.partition("\n\n")[0], re.MULTILINE))
    sources = [*(repository / "clients").rglob("*.py"), *(repository / "app/registry").glob("*.py")]
    read = {name for path in sources for name in re.findall(r'"(SCENE_[A-Z_]+)"', path.read_text())}
    assert listed == read
