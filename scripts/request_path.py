"""``python -m scripts.request_path``: list the functions of this project that a request calls.

The script sends a scene with poses to an application in this process, after 20 warm-up requests.
It lists the Python functions and compiled kernels of `app` and `scene_client` that the request
calls. A comprehension or lambda counts as part of the function that contains it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any

from numba.core.dispatcher import Dispatcher

from app.main import create_app
from app.settings import Settings

ROOT = Path(__file__).resolve().parent.parent
OURS = (f"{ROOT / 'app'}/", f"{ROOT / 'clients'}/")
INSIDE = {"<listcomp>", "<genexpr>", "<setcomp>", "<dictcomp>", "<lambda>"}
SCENE = {
    "objects": [
        {"label": label, "position": [2.0 + 0.1 * k, 0.3 * k, 0.5], "size": [0.5, 0.5, 1.0]}
        for k, label in enumerate(("bed", "lamp", "chair", "desk", "pillow", "book", "sofa"))
    ]
}


async def ask(app: Any, path: str, body: bytes) -> int:
    """Send one request to an application and return the status of the answer."""
    statuses: list[int] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: dict[str, Any]) -> None:
        statuses.append(message.get("status", 0))

    headers = [(b"host", b"localhost"), (b"content-type", b"application/json")]
    scope = {
        "type": "http", "method": "POST", "path": path, "raw_path": path.encode(),
        "query_string": b"", "root_path": "", "scheme": "http", "headers": headers, "state": {},
    }  # fmt: skip
    await app(scope, receive, send)
    return statuses[0]


@contextmanager
def compiled_calls(calls: set[tuple[str, str]]) -> Iterator[None]:
    """Record calls of compiled functions in `calls`. A Python profiler does not see these calls."""
    replaced: list[tuple[Any, str, Any]] = []
    for module in [m for name, m in sys.modules.items() if name.startswith("app.")]:
        for name, value in list(vars(module).items()):
            if isinstance(value, Dispatcher):
                replaced.append((module, name, value))
                setattr(module, name, recorded(value, calls))
    try:
        yield
    finally:
        for module, name, value in replaced:
            setattr(module, name, value)


def recorded(loop: Any, calls: set[tuple[str, str]]) -> Callable[..., Any]:
    code = loop.py_func.__code__

    @wraps(loop.py_func)
    def call(*args: Any) -> Any:
        calls.add((str(Path(code.co_filename).relative_to(ROOT)), code.co_name))
        return loop(*args)

    return call


async def called_functions(path: str, body: bytes, requests: int = 20) -> set[tuple[str, str]]:
    """Return (file, function) of all project functions that one request calls.

    Args:
        path: path of the request.
        body: JSON body of the request.
        requests: number of warm-up requests.
    """
    app = create_app(Settings())
    calls: set[tuple[str, str]] = set()
    is_counting = False

    def record(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if (
            is_counting
            and event == "call"
            and code.co_filename.startswith(OURS)
            and code.co_name not in INSIDE
        ):
            calls.add((str(Path(code.co_filename).relative_to(ROOT)), code.co_qualname))

    # Also profile new threads, because a thread computes the answer on a busy machine.
    threading.setprofile(record)
    async with app.router.lifespan_context(app):
        for _ in range(requests):
            assert await ask(app, path, body) == 200
        with compiled_calls(calls):
            is_counting = True
            sys.setprofile(record)
            await ask(app, path, body)
            sys.setprofile(None)
    return calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", nargs="?", default="/missing")
    path = parser.parse_args().path
    calls = sorted(asyncio.run(called_functions(path, json.dumps(SCENE).encode())))
    files = sorted({file for file, _ in calls})
    for file in files:
        names = ", ".join(name for other, name in calls if other == file)
        sys.stdout.write(f"{file}: {names}\n")
    sys.stdout.write(f"one {path}: {len(files)} files, {len(calls)} functions\n")


if __name__ == "__main__":
    main()
