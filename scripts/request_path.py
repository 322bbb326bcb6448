"""``python -m scripts.request_path``: list the functions of this project that a request calls.

The script sends a scene with poses to an application in this process, after 20 warm-up requests.
It lists the Python functions and compiled kernels of `app` and `scene_client` that the request
calls. A comprehension or lambda counts as part of the function that contains it.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any

import httpx
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


async def called_functions(path: str, body: Any, requests: int = 20) -> set[tuple[str, str]]:
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
    transport = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        for _ in range(requests):
            (await client.post(path, json=body)).raise_for_status()
        with compiled_calls(calls):
            is_counting = True
            sys.setprofile(record)
            await client.post(path, json=body)
            sys.setprofile(None)
    return calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", nargs="?", default="/missing")
    path = parser.parse_args().path
    calls = sorted(asyncio.run(called_functions(path, SCENE)))
    files = sorted({file for file, _ in calls})
    for file in files:
        names = ", ".join(name for other, name in calls if other == file)
        sys.stdout.write(f"{file}: {names}\n")
    sys.stdout.write(f"one {path}: {len(files)} files, {len(calls)} functions\n")


if __name__ == "__main__":
    main()
