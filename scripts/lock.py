"""Write the lock files requirements*.lock, with exact versions, from both pyproject.toml files.

pip first resolves the requirements for development, without installing them. Then it resolves the
smaller sets of requirements with the same versions. A package therefore has the same version in all
lock files.

Usage: python scripts/lock.py   (or `make lock`; further arguments are passed to pip)
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HEADER = "# {what}. Written by `make lock` from pyproject.toml; do not edit.\n"

# Dependencies of the CUDA builds of torch. The lock files leave them out, because a locked package
# would also be installed on machines without a GPU.
CUDA_COMPANION = re.compile(r"^(cuda-|nvidia-|triton$)")


def resolve(requirements: list[str], pins: Path | None, pip_arguments: list[str]) -> dict[str, str]:
    """Resolve requirements. Return a line `name==version` for each package, by package name.

    Args:
        pins: file with versions that pip must use. None means no restriction.
    """
    command = [
        *(sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "-qq"),
        *("--dry-run", "--ignore-installed", "--report", "-"),
        *(("--constraint", str(pins)) if pins else ()),
        *pip_arguments,
        *requirements,
    ]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    locked: dict[str, str] = {}
    for item in report["install"]:
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        key = re.sub(r"[-_.]+", "-", name).lower()
        if not CUDA_COMPANION.match(key):
            # A local version such as 2.13.0+cpu names one build. The part before "+" fits all.
            locked[key] = f"{key}=={version.partition('+')[0]}"
    return locked


def with_markers(locked: dict[str, str], requirements: list[str]) -> list[str]:
    """Return the sorted lines of a lock file, with the environment markers of pyproject.toml."""
    markers: dict[str, str] = {}
    for requirement in requirements:
        name, _, marker = requirement.partition(";")
        if marker:
            key = re.split(r"[<>=!~\[ ]", name.strip(), maxsplit=1)[0]
            markers[re.sub(r"[-_.]+", "-", key).lower()] = marker.strip()
    return [
        f"{pin}; {markers[key]}" if key in markers else pin for key, pin in sorted(locked.items())
    ]


def main(pip_arguments: list[str]) -> None:
    client, project = (
        tomllib.loads((ROOT / folder / "pyproject.toml").read_text("utf-8"))["project"]
        for folder in ("clients/python", ".")
    )
    extras = project["optional-dependencies"]
    runtime = client["dependencies"] + extras["service"]
    training = runtime + extras["training"]
    development = training + extras["telemetry"] + extras["docs"] + extras["dev"]

    with tempfile.TemporaryDirectory() as scratch:
        pins = Path(scratch) / "constraints.txt"
        locked = resolve(development, None, pip_arguments)
        pins.write_text("\n".join(locked.values()), "utf-8")
        for path, what, wanted in (
            ("requirements-dev.lock", "Everything: service, training, checks", development),
            ("requirements-training.lock", "The service and training", training),
            ("requirements.lock", "The service alone", runtime),
            ("requirements-ray.lock", "The service and Ray Serve", runtime + extras["ray"]),
        ):
            if wanted is not development:
                locked = resolve(wanted, pins, pip_arguments)
            text = HEADER.format(what=what) + "\n".join(with_markers(locked, wanted)) + "\n"
            (ROOT / path).write_text(text, "utf-8")
            print(f"{path}: {len(locked)} packages")


if __name__ == "__main__":
    main(sys.argv[1:])
