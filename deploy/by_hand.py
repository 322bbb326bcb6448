#!/usr/bin/env python3
"""Build and start the image without a container engine: execute the Dockerfile's instructions.

    python3 deploy/by_hand.py                    build, start, wait for the health check, stop
    python3 deploy/by_hand.py --stay             the same, but serve until Ctrl-C
    python3 deploy/by_hand.py --target train     build the training stage and run its command

Each stage has its own folder in place of its root directory. The paths that the Dockerfile creates
(WORKDIR, destinations of COPY, /tmp) are moved into this folder. All other paths are those of this
machine. COPY obeys .dockerignore. The service is ready when the image's HEALTHCHECK succeeds. The
script does not test the base image, because it uses the machine's Python, or the isolation of a
container.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import signal
import socket
import string
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

# Variables that a build inherits: settings of pip, proxies, certificates and the language.
PASSED_ON = re.compile(r"^(PIP_.*|SSL_CERT_.*|https?_proxy|no_proxy|LANG)$", re.IGNORECASE)
KNOWN = {
    *("FROM", "ARG", "ENV", "WORKDIR", "COPY", "RUN", "USER"),
    *("EXPOSE", "HEALTHCHECK", "ENTRYPOINT", "CMD"),
}


class ReplayError(Exception):
    """The Dockerfile cannot be executed, or the built stage does not work."""


@dataclass(frozen=True, slots=True)
class Instruction:
    """One instruction: `COPY --from=a b c` has the fields COPY, {"from": "a"} and "b c"."""

    keyword: str
    flags: dict[str, str]
    argument: str


def parse(text: str) -> list[Instruction]:
    """Split a Dockerfile into instructions.

    Raises:
        ReplayError: this script does not support an instruction.
    """
    lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
    instructions = []
    for line in re.sub(r"\\[ \t]*\n", " ", "\n".join(lines)).splitlines():
        if not line.strip():
            continue
        keyword, _, rest = line.strip().partition(" ")
        keyword, rest = keyword.upper(), rest.strip()
        if keyword not in KNOWN:
            raise ReplayError(f"{keyword} is an instruction that this script does not support")
        flags = {}
        while match := re.match(r"--([\w-]+)=(\S+)\s*", rest):
            flags[match[1]] = match[2]
            rest = rest[match.end() :]
        instructions.append(Instruction(keyword, flags, rest))
    return instructions


def split_stages(instructions: list[Instruction]) -> dict[str, list[Instruction]]:
    """Return the instructions of each stage by stage name, in the order of the file."""
    stages: dict[str, list[Instruction]] = {}
    for instruction in instructions:
        if instruction.keyword == "FROM":
            _, _, name = instruction.argument.partition(" AS ")
            current = stages.setdefault(name.strip() or str(len(stages)), [])
        elif not stages:
            raise ReplayError(f"{instruction.keyword} is before the first FROM")
        current.append(instruction)
    return stages


def ignore_rules(text: str) -> list[tuple[bool, re.Pattern[str]]]:
    """Return the lines of a .dockerignore as pairs (is an exception, path pattern), in order."""
    rules = []
    for line in text.splitlines():
        pattern = line.strip()
        if not pattern or pattern.startswith("#"):
            continue
        excepted, pattern = pattern.startswith("!"), pattern.removeprefix("!").strip("/")
        regex = re.escape(pattern).replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*")
        rules.append((excepted, re.compile(f"{regex}(/.*)?")))
    return rules


def is_ignored(path: str, rules: list[tuple[bool, re.Pattern[str]]]) -> bool:
    """Return whether the last rule that matches `path` excludes it from the build context."""
    verdicts = [not excepted for excepted, pattern in rules if pattern.fullmatch(path)]
    return bool(verdicts) and verdicts[-1]


@dataclass
class Stage:
    """A stage during its build: its folder in place of a root directory, and its settings."""

    root: Path
    environment: dict[str, str]
    workdir: str = "/"
    user: str = ""
    healthcheck: list[str] = field(default_factory=list)
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)


class Replay:
    """Builds the stages of one Dockerfile under `work`."""

    def __init__(self, context: Path, work: Path, build_arguments: dict[str, str]) -> None:
        self.context = context
        self.work = work
        self.build_arguments = build_arguments
        self.stages = split_stages(parse((context / "Dockerfile").read_text("utf-8")))
        ignore_file = context / ".dockerignore"
        self.rules = ignore_rules(ignore_file.read_text("utf-8")) if ignore_file.exists() else []
        self.built: dict[str, Stage] = {}
        made = {"/tmp"}
        for instruction in (i for stage in self.stages.values() for i in stage):
            if instruction.keyword == "WORKDIR":
                made.add(instruction.argument.rstrip("/"))
            elif instruction.keyword == "COPY":
                made.add(shlex.split(instruction.argument)[-1].rstrip("/"))
        absolute = sorted((p for p in made if p.startswith("/")), key=len, reverse=True)
        self.made_paths = re.compile(
            rf"(?<![\w./-])({'|'.join(map(re.escape, absolute))})(?![\w-])"
        )

    def inside(self, stage: Stage, text: str) -> str:
        """Return `text` with the paths of the Dockerfile moved into the stage's folder."""
        return self.made_paths.sub(lambda match: f"{stage.root}{match[1]}", text)

    def build(self, name: str) -> Stage:
        """Build a stage, after the stages that it starts from or copies from."""
        if name in self.built:
            return self.built[name]
        if name not in self.stages:
            raise ReplayError(
                f"the Dockerfile has no stage {name!r}; its stages are {', '.join(self.stages)}"
            )
        first, *rest = self.stages[name]
        base = first.argument.partition(" AS ")[0].strip()
        stage = self.derived(name, self.build(base)) if base in self.stages else self.fresh(name)
        for instruction in rest:
            shown = f"{instruction.keyword} {instruction.argument}"
            print(f"[{name}] {shown if len(shown) <= 100 else shown[:99] + '…'}", flush=True)
            self.apply(stage, instruction)
        self.built[name] = stage
        return stage

    def fresh(self, name: str) -> Stage:
        """Return an empty stage with the machine's Python in place of the base image."""
        root = self.work / name
        programs = root / "base-image" / "bin"
        programs.mkdir(parents=True)
        (root / "tmp").mkdir()
        (root / "tmp").chmod(0o1777)
        (programs / "python").symlink_to(Path(sys.executable).resolve())
        environment = {key: value for key, value in os.environ.items() if PASSED_ON.match(key)}
        environment |= {"PATH": f"{programs}:/usr/bin:/bin", "HOME": str(root / "tmp")}
        return Stage(root, environment)

    def derived(self, name: str, base: Stage) -> Stage:
        """Return a stage that starts with a copy of another stage."""
        root = self.work / name
        shutil.copytree(base.root, root, symlinks=True, copy_function=os.link)
        environment = {
            key: value.replace(f"{base.root}/", f"{root}/")
            for key, value in base.environment.items()
        }
        return Stage(root, environment, base.workdir, base.user)

    def apply(self, stage: Stage, instruction: Instruction) -> None:
        """Execute one instruction."""
        argument = instruction.argument
        match instruction.keyword:
            case "ARG":
                name, _, default = argument.partition("=")
                value = self.build_arguments.get(name, "".join(shlex.split(default)))
                stage.environment[name] = value
            case "ENV":
                for assignment in shlex.split(argument):
                    name, _, value = assignment.partition("=")
                    expanded = string.Template(self.inside(stage, value))
                    stage.environment[name] = expanded.safe_substitute(stage.environment)
            case "WORKDIR":
                stage.workdir = str(Path(stage.workdir, argument))
                self.directory(stage).mkdir(parents=True, exist_ok=True)
            case "COPY":
                self.copy(stage, instruction)
            case "RUN":
                self.execute(stage, ["/bin/sh", "-c", self.inside(stage, argument)])
            case "USER":
                stage.user = argument
            case "HEALTHCHECK":
                stage.healthcheck = json.loads(argument.partition("CMD")[2])
            case "ENTRYPOINT":
                stage.entrypoint = json.loads(argument)
            case "CMD":
                stage.command = json.loads(argument)

    def directory(self, stage: Stage) -> Path:
        """Return the stage's working directory on this machine."""
        return stage.root / stage.workdir.lstrip("/")

    def copy(self, stage: Stage, instruction: Instruction) -> None:
        """Execute COPY from the build context or from another stage."""
        *sources, target = shlex.split(instruction.argument)
        destination = stage.root / str(Path(stage.workdir, target)).lstrip("/")
        into = target.endswith("/") or len(sources) > 1
        if "from" in instruction.flags:
            origin = self.build(instruction.flags["from"]).root
            for source in sources:
                # Hard links are safe, because no instruction changes these files in place.
                shutil.copytree(
                    origin / source.lstrip("/"),
                    destination / Path(source).name if into else destination,
                    symlinks=True,
                    copy_function=os.link,
                )
            return
        for source in sources:
            copied = 0
            for path in self.context_files(self.context / source):
                if path == self.context / source:  # a file; COPY of a folder copies its contents
                    place = destination / path.name if into else destination
                else:
                    place = destination / path.relative_to(self.context / source)
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, place)
                copied += 1
            if not copied:
                raise ReplayError(
                    f"COPY {source}: the file does not exist, or .dockerignore excludes it"
                )
        if "chown" in instruction.flags and os.geteuid() == 0:
            user, _, group = instruction.flags["chown"].partition(":")
            for path in (destination, *destination.rglob("*")):
                os.chown(path, int(user), int(group or user))

    def context_files(self, source: Path) -> Iterator[Path]:
        """Iterate over the files at or below `source` in the build context."""
        candidates = [source] if source.is_file() else sorted(source.rglob("*"))
        for path in candidates:
            if path.is_file() and not is_ignored(
                path.relative_to(self.context).as_posix(), self.rules
            ):
                yield path

    def execute(self, stage: Stage, command: list[str]) -> None:
        """Run a command in the stage.

        Raises:
            ReplayError: the command failed.
        """
        done = subprocess.run(
            command, cwd=self.directory(stage), env=stage.environment, check=False
        )
        if done.returncode:
            raise ReplayError(f"exit status {done.returncode} from: {shlex.join(command)}")


def identity(stage: Stage) -> tuple[int, int] | None:
    """Return user and group of the image, or None if this process cannot change to them."""
    if not stage.user:
        return None
    user, _, group = stage.user.partition(":")
    wanted = int(user), int(group or user)
    if os.geteuid() == 0:
        try:
            # Other users may have no access to the folder of the interpreter.
            subprocess.run(
                ["python", "-c", ""],
                env=stage.environment,
                check=True,
                stderr=subprocess.DEVNULL,
                user=wanted[0],
                group=wanted[1],
            )
        except (OSError, subprocess.CalledProcessError):
            pass
        else:
            return wanted
    print(f"note: USER {stage.user} is not applied; the service runs as uid {os.geteuid()}")
    return None


def snapshot(root: Path) -> dict[str, tuple[int, int]]:
    """Return (size, modification time) of every file outside the stage's /tmp, by path."""
    return {
        str(path.relative_to(root)): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in root.rglob("*")
        if path.is_file() and not path.is_relative_to(root / "tmp")
    }


def serve(replay: Replay, stage: Stage, port: int, patience: float, stay: bool) -> None:
    """Start the stage's command, wait for its HEALTHCHECK, and stop it.

    Raises:
        ReplayError: the service failed, or wrote a file outside /tmp.
    """
    environment = stage.environment | {"SCENE_HOST": "127.0.0.1", "SCENE_PORT": str(port)}
    user, group = identity(stage) or (None, None)
    before = snapshot(stage.root)
    started = time.monotonic()
    service = subprocess.Popen(
        stage.entrypoint + stage.command,
        cwd=replay.directory(stage),
        env=environment,
        user=user,
        group=group,
    )
    try:
        while subprocess.run(
            stage.healthcheck, env=environment, check=False, stderr=subprocess.DEVNULL
        ).returncode:
            if service.poll() is not None:
                raise ReplayError(f"the service ended with status {service.returncode}")
            if time.monotonic() - started > patience:
                raise ReplayError(f"the service was not healthy within {patience:.0f} s")
            time.sleep(0.2)
        elapsed = time.monotonic() - started
        print(f"healthy after {elapsed:.1f} s on http://127.0.0.1:{port}", flush=True)
        if stay:
            service.wait()
    except KeyboardInterrupt:
        pass
    finally:
        service.send_signal(signal.SIGTERM)
        try:
            service.wait(timeout=30)
        except subprocess.TimeoutExpired:
            service.kill()
            raise ReplayError("the service did not stop within 30 s of SIGTERM") from None
    if service.returncode not in (0, -signal.SIGTERM):
        raise ReplayError(f"the service ended with status {service.returncode} after SIGTERM")
    after = snapshot(stage.root)
    if written := sorted(
        name for name in after.keys() | before if after.get(name) != before.get(name)
    ):
        raise ReplayError(
            f"with a read-only root, these files could not be written: {written[:10]}"
        )


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main() -> int:
    """Parse the command line and build the target stage."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--target", help="stage to build; default: the last stage")
    parser.add_argument("--port", type=int, help="port of the service; default: any free port")
    parser.add_argument("--wait", type=float, default=60, help="seconds to wait until healthy")
    parser.add_argument("--stay", action="store_true", help="serve until Ctrl-C")
    options = parser.parse_args()

    context = Path(__file__).resolve().parent.parent
    arguments = {key: os.environ[key] for key in ("TORCH_INDEX_URL",) if key in os.environ}
    with tempfile.TemporaryDirectory(prefix="by-hand-") as work:
        Path(work).chmod(0o755)  # the image's user must be able to enter
        try:
            replay = Replay(context, Path(work), arguments)
            target = options.target or list(replay.stages)[-1]
            stage = replay.build(target)
            if stage.healthcheck:
                serve(replay, stage, options.port or free_port(), options.wait, options.stay)
            else:
                replay.execute(stage, stage.entrypoint + stage.command)
        except ReplayError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    print(f"{target}: built and run")
    return 0


if __name__ == "__main__":
    sys.exit(main())
