#!/usr/bin/env python3
"""Build the image from the Dockerfile, start it, and ask it its questions.

    python3 deploy/image.py                      Docker if it runs here, else buildah
    python3 deploy/image.py --engine buildah     needs root, buildah and debootstrap, but no daemon

The script checks the image's size, user, HEALTHCHECK and packages, and that the service writes only
to /tmp.
Then it removes its containers and images. Docker enforces a read-only root. Under buildah, the
script looks for written files, because chroot isolation has a writable root.

If buildah cannot pull the base image, debootstrap makes a stand-in: the same Debian with Debian's
Python. The cache folder keeps the stand-in. Mirror, certificates and package index are those of
this machine (apt, environment variables, pip). The image contains none of these settings.
"""

from __future__ import annotations

import argparse
import ast
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
USER = 10001
MAX_BYTES = 800_000_000
HEALTHY_WITHIN = 60.0
MIRROR = "http://deb.debian.org/debian"
BUNDLE = "/etc/ssl/certs/ca-certificates.crt"
QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("relations", {"objects": ["lamp", "nightstand"]}),
    ("missing", {"objects": ["bed"], "at": {"relation": "on-top", "object": "bed"}}),
    ("outliers", {"objects": ["bed", "pillow", "nightstand", "lamp", "toilet"]}),
    ("rooms", {"objects": ["bed", "pillow", "nightstand"]}),
    ("generate", {"objects": ["bed"], "seed": 1}),
]


# Fails if COPY did not obey .dockerignore. The compilation of kernels writes __pycache__ itself.
CONTENTS = """test "$(echo *)" = "app compiled model_store models scene_client" &&
    test "$(stat -c %u models)" = 10001 && test -z "$(find app scene_client -name .numba_cache)" """

# Lists the installed packages as a lock file does.
PACKAGES = """import importlib.metadata as m
for d in m.distributions(): print(d.metadata["Name"].lower().replace("_", "-"), d.version, sep="==")
"""


class ImageError(Exception):
    """The image cannot be built, or it fails a check."""


def descendants(pid: int) -> list[int]:
    """Return a process and all processes below it, parents first."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:  # the process has ended
            continue
    found = [pid]
    for known in found:
        found.extend(child for child, parent in parents.items() if parent == known)
    return found


def end(process: subprocess.Popen[str]) -> None:
    """End a process that this script started, and all processes below it."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        for pid in reversed(descendants(process.pid)):
            try:
                os.kill(pid, number)
            except ProcessLookupError:
                continue
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            continue


def run(*command: str | Path, cwd: Path = ROOT) -> str:
    """Run a command and return its output.

    Raises:
        ImageError: the command failed; the message ends with its output.
    """
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, cwd=cwd, stdin=subprocess.DEVNULL, **streams)
    try:
        output, _ = process.communicate()
    except BaseException:
        end(process)
        raise
    if process.returncode:
        name = " ".join(str(part) for part in command[:3])
        raise ImageError(f"{name} … failed:\n{output[-4000:]}")
    return output.strip()


def first_base(dockerfile: str) -> str:
    """Return the image of the first FROM."""
    match = re.search(r"^FROM\s+(\S+)", dockerfile, re.MULTILINE)
    assert match
    return match[1]


def pip_settings(listing: str) -> tuple[str, list[str]]:
    """Convert the output of `pip config list` to a pip.conf and the local paths in its values."""
    sections: dict[str, dict[str, str]] = {}
    for line in listing.splitlines():
        name, _, quoted = line.partition("=")
        section, _, key = name.rpartition(".")
        section = "global" if section == ":env:" else section
        value = ast.literal_eval(quoted)
        sections.setdefault(section, {})[key] = value.strip().replace("\n", "\n    ")
    text = "".join(
        f"[{section}]\n" + "".join(f"{key} = {value}\n" for key, value in values.items())
        for section, values in sections.items()
    )
    words = " ".join(value for values in sections.values() for value in values.values()).split()
    # A local index is a folder `simple`, which refers to files beside it.
    paths = {word.removeprefix("file://").rstrip("/").removesuffix("/simple") for word in words}
    return text, sorted(path for path in paths if path.startswith("/"))


class Docker:
    """Builds and runs the image with Docker."""

    def __init__(self, work: Path) -> None:
        self.id_file = work / "image-id"
        self.tag = f"scene-boltzmann-check:{os.getpid()}"
        self.container = ""

    @staticmethod
    def works() -> bool:
        return (
            bool(shutil.which("docker"))
            and not subprocess.run(["docker", "info"], capture_output=True, check=False).returncode
        )

    def build(self) -> None:
        run("docker", "build", "--iidfile", self.id_file, "--tag", self.tag, ".")
        self.image = self.id_file.read_text("utf-8").strip()

    def inspect(self) -> tuple[int, dict[str, Any]]:
        (found,) = json.loads(run("docker", "image", "inspect", self.image))
        return found["Size"], found["Config"]

    def start(self, config: dict[str, Any], port: int) -> None:
        confined = ["--read-only", "--tmpfs=/tmp", "--cap-drop=ALL"]
        publish = f"--publish=127.0.0.1:{port}:8000"
        privileges = "--security-opt=no-new-privileges"
        command = ["docker", "run", "--detach", *confined, privileges, publish, self.image]
        self.container = run(*command)

    def execute(self, command: Sequence[str]) -> str:
        return run("docker", "exec", self.container, *command)

    def is_running(self) -> bool:
        return run("docker", "inspect", "-f", "{{.State.Running}}", self.container) == "true"

    def users(self) -> set[int]:
        listing = run("docker", "top", self.container, "-eo", "pid,uid").splitlines()[1:]
        return {int(line.split()[1]) for line in listing}

    def stop(self) -> None:
        run("docker", "stop", "--time", "30", self.container)
        if run("docker", "inspect", "-f", "{{.State.ExitCode}}", self.container) == "137":
            raise ImageError("the service did not end within 30 s of SIGTERM")

    def log(self) -> str:
        return run("docker", "logs", self.container)

    def clean(self) -> None:
        if self.container:
            run("docker", "rm", "--force", self.container)
        if self.id_file.exists():
            run("docker", "rmi", self.tag)  # by tag: an image of the user may have the same id


class Buildah:
    """Builds and runs the image with buildah, in a storage folder below `work`."""

    def __init__(self, work: Path, cache: Path) -> None:
        self.work, self.cache = work, cache
        self.service: subprocess.Popen[str] | None = None
        self.output = work / "service.log"
        os.environ["TMPDIR"] = str(work)  # the folder of buildah's temporary files

    @staticmethod
    def works() -> bool:
        return os.geteuid() == 0 and all(map(shutil.which, ("buildah", "debootstrap")))

    def command(self, *arguments: str | Path) -> list[str | Path]:
        storage = ("--root", self.work / "storage", "--runroot", self.work / "run")
        return ["buildah", *storage, "--storage-driver", "vfs", *arguments]

    def build(self) -> None:
        base = self.base_image()
        flags = ["--isolation", "chroot", "--network", "host", "--format", "docker"]
        id_file = self.work / "image-id"
        names = ("--pull-never", "--from", base, "--iidfile", id_file)
        run(*self.command("build", *flags, *names, *self.mounts(), "."))
        self.image = id_file.read_text("utf-8").strip()

    def base_image(self) -> str:
        """Return the id of the base image, pulled or replaced by the stand-in."""
        name = first_base((ROOT / "Dockerfile").read_text("utf-8"))
        try:
            return run(*self.command("pull", "--quiet", f"docker.io/library/{name}"))
        except ImageError as error:
            reason = str(error).rpartition(": ")[2].strip()
            print(f"note: no base image {name}, because: {reason}", flush=True)
        archive = self.stand_in(name.rpartition("-")[2].partition("@")[0])
        context = self.work / "base"
        context.mkdir()
        shutil.copyfile(archive, context / "base.tar")
        (context / "Dockerfile").write_text("FROM scratch\nADD base.tar /\n")
        identifier = run(*self.command("build", "--quiet", "--isolation", "chroot", context))
        return identifier.splitlines()[-1]

    def stand_in(self, release: str) -> Path:
        """Return an archive of a Debian with Python, from the cache or by debootstrap."""
        archive = self.cache / f"base-{release}.tar"
        if archive.exists():
            return archive
        print(f"debootstrap of {release} …", flush=True)
        root = self.work / "root"
        packages = "--include=python3,python3-venv,ca-certificates"
        run("debootstrap", "--variant=minbase", packages, release, root, mirror(release))
        (root / "usr/bin/python").symlink_to("python3")
        self.cache.mkdir(parents=True, exist_ok=True)
        partial = archive.with_suffix(f".{os.getpid()}")
        unneeded = ("./dev/*", "./var/cache/apt/*", "./var/lib/apt/lists/*")
        try:
            excluded = [f"--exclude={pattern}" for pattern in unneeded]
            run("tar", "-C", root, *excluded, "-cf", partial, ".")
            partial.rename(archive)
        finally:
            partial.unlink(missing_ok=True)
        return archive

    def mounts(self) -> list[str]:
        """Return the options that mount this machine's pip settings and certificates."""
        text, paths = pip_settings(run(sys.executable, "-m", "pip", "config", "list"))
        settings = self.work / "pip.conf"
        settings.write_text(text)
        places = {path: path for path in (BUNDLE, *paths) if Path(path).exists()}
        if "SSL_CERT_FILE" in os.environ:
            places[BUNDLE] = os.environ["SSL_CERT_FILE"]
        places["/etc/pip.conf"] = str(settings)
        return [f"--volume={source}:{place}:ro" for place, source in places.items()]

    def inspect(self) -> tuple[int, dict[str, Any]]:
        (found,) = json.loads(run(*self.command("images", "--json", self.image)))
        details = json.loads(run(*self.command("inspect", "--type", "image", self.image)))
        unit = {"KB": 1e3, "MB": 1e6, "GB": 1e9}
        number, _, name = found["size"].partition(" ")
        return int(float(number) * unit[name]), details["Docker"]["config"]

    def start(self, config: dict[str, Any], port: int) -> None:
        self.container = run(*self.command("from", self.image))
        self.root = Path(run(*self.command("mount", self.container)))
        self.started = time.time()
        settings = "SCENE_HOST=127.0.0.1", f"SCENE_PORT={port}", f"SCENE_HEALTH_PORT={free_port()}"
        self.variables = [part for setting in settings for part in ("--env", setting)]
        with self.output.open("w") as log:
            streams = {"stdout": log, "stderr": log, "text": True}
            self.service = subprocess.Popen(self.inside(config["Cmd"]), **streams)

    def inside(self, command: Sequence[str]) -> list[str | Path]:
        flags = ["--isolation", "chroot", "--network", "host", *self.variables]
        return self.command("run", *flags, self.container, "--", *command)

    def execute(self, command: Sequence[str]) -> str:
        return run(*self.inside(command))

    def is_running(self) -> bool:
        return self.service.poll() is None

    def service_pid(self) -> int:
        for pid in descendants(self.service.pid):
            if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"python\0-m\0app"):
                return pid
        raise ImageError("the process of the service is missing")

    def users(self) -> set[int]:
        return {Path(f"/proc/{self.service_pid()}").stat().st_uid}

    def stop(self) -> None:
        """Stop the service with SIGTERM, and look for its files outside /tmp."""
        os.kill(self.service_pid(), signal.SIGTERM)
        try:
            self.service.wait(timeout=30)
        except subprocess.TimeoutExpired:
            raise ImageError("the service did not end within 30 s of SIGTERM") from None
        written = [
            str(path.relative_to(self.root))
            for path in self.root.rglob("*")
            if not path.is_relative_to(self.root / "tmp")
            and (status := path.lstat()).st_uid == USER
            and status.st_ctime >= self.started
        ]
        if written:
            raise ImageError(f"the service wrote outside /tmp: {written[:10]}")

    def log(self) -> str:
        return self.output.read_text("utf-8")

    def clean(self) -> None:
        """End the service and remove all mounts. The caller removes the folder."""
        if self.service:
            end(self.service)
        # Without this, removing the folder would delete mounted files of this machine.
        lines = Path("/proc/self/mountinfo").read_text("utf-8").splitlines()
        for place in reversed([line.split()[4] for line in lines]):
            if place.startswith(f"{self.work}/"):
                run("umount", "--lazy", place)


def mirror(release: str) -> str:
    """Return the mirror of a Debian release in the settings of apt, or Debian's own."""
    listing = run("apt-get", "indextargets", "--format", "$(REPO_URI) $(RELEASE) $(COMPONENT)")
    for line in listing.splitlines():
        uri, *rest = line.split()
        if rest == [release, "main"]:
            return uri
    return MIRROR


def ask(port: int, question: str, body: dict[str, Any]) -> dict[str, Any]:
    """Return the answer to a question.

    Raises:
        ImageError: the status is not 200.
    """
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    headers = {"Content-Type": "application/json"}
    connection.request("POST", f"/{question}", json.dumps(body), headers)
    response = connection.getresponse()
    text = response.read().decode()
    if response.status != 200:
        raise ImageError(f"/{question} has status {response.status}: {text[:500]}")
    return json.loads(text)


def is_plausible(answers: dict[str, Any]) -> dict[str, bool]:
    """Return for each question whether its answer has the expected content."""
    first = answers["relations"]["relations"][0]
    outliers = [thing["label"] for thing in answers["outliers"]["outliers"] if thing["is_outlier"]]
    return {
        "relations": (first["subject"], first["relation"]) == ("lamp", "on-top"),
        "missing": answers["missing"]["missing"][0]["label"] == "pillow",
        "outliers": outliers == ["toilet"],
        "rooms": answers["rooms"]["room_types"][0]["room_type"] == "bedroom",
        "generate": "bed" in answers["generate"]["scenes"][0]["objects"],
    }


def free_port() -> int:
    """Return a free port of the loopback address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def check_packages(listing: str, lock: str) -> None:
    """Compare the packages of the image with its lock file, of which the bill of materials is made.

    Raises:
        ImageError: they differ.
    """
    locked = {line.split()[0] for line in lock.splitlines() if line[0].isalnum()}
    if differing := locked ^ set(listing.split()):
        raise ImageError(f"the image and requirements.lock differ in {sorted(differing)}")


def wait_until_healthy(engine: Docker | Buildah, check: list[str]) -> float:
    """Wait until the HEALTHCHECK succeeds, and return the seconds."""
    started = time.monotonic()
    while True:
        try:
            engine.execute(check)
        except ImageError as error:
            if not engine.is_running():
                raise ImageError(f"the service ended:\n{engine.log()[-4000:]}") from None
            if time.monotonic() - started > HEALTHY_WITHIN:
                log = engine.log()[-4000:]
                raise ImageError(f"not healthy in {HEALTHY_WITHIN} s: {error}\n{log}") from None
            time.sleep(0.2)
        else:
            return time.monotonic() - started


def check(engine: Docker | Buildah) -> None:
    """Build the image, run it, and check it."""
    started = time.monotonic()
    engine.build()
    size, config = engine.inspect()
    print(f"built in {time.monotonic() - started:.0f} s: {size / 1e6:.0f} MB, {engine.image}")
    if size > MAX_BYTES:
        raise ImageError(f"the image is larger than {MAX_BYTES / 1e6:.0f} MB")
    kind, *healthcheck = (config.get("Healthcheck") or {}).get("Test") or ["NONE"]
    if kind != "CMD":
        raise ImageError("the image has no HEALTHCHECK with a list of arguments")
    engine.start(config, port := free_port())
    print(f"healthy after {wait_until_healthy(engine, healthcheck):.1f} s", flush=True)
    engine.execute(["sh", "-c", CONTENTS])
    lock = (ROOT / "requirements.lock").read_text("utf-8")
    check_packages(engine.execute(["python", "-c", PACKAGES]), lock)
    answers = {question: ask(port, question, body) for question, body in QUESTIONS}
    if wrong := [name for name, good in is_plausible(answers).items() if not good]:
        raise ImageError("; ".join(f"unexpected /{name}: {answers[name]}"[:2000] for name in wrong))
    if (users := engine.users()) != {USER}:
        raise ImageError(f"the service runs as user {users}, not {USER}")
    engine.stop()
    print(f"all questions answered by user {USER}; nothing written outside /tmp")


def main() -> int:
    """Parse the command line, check the image, and remove it."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--engine", choices=["docker", "buildah"], help="default: one that works")
    parser.add_argument(
        "--cache", type=Path, default=Path(home, "scene-boltzmann"), help="folder of the stand-in"
    )
    options = parser.parse_args()
    engines = {"docker": Docker, "buildah": Buildah}
    chosen = options.engine or next((name for name in engines if engines[name].works()), None)
    if chosen is None:
        print("error: needs Docker, or buildah and debootstrap as root", file=sys.stderr)
        return 1
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    work = Path(tempfile.mkdtemp(prefix="scene-image-")).resolve()
    engine = Docker(work) if chosen == "docker" else Buildah(work, options.cache.resolve())
    try:
        print(f"building with {chosen} …", flush=True)
        check(engine)
    except ImageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        engine.clean()
        shutil.rmtree(work)
    return 0


if __name__ == "__main__":
    sys.exit(main())
