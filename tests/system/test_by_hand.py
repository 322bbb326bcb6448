"""The replay of a Dockerfile without a container engine, on small ones of its own."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from deploy.by_hand import Replay, ReplayError, ignore_rules, is_ignored, parse, serve

pytestmark = pytest.mark.system

DOCKERFILE = r"""
# a comment, with a \
FROM some/image:1 AS base
ENV GREETING="hello there" \
    # a comment inside an instruction
    PATH=/opt/tools:$PATH
WORKDIR /srv/thing

FROM base AS packages
ARG FLAVOUR="plain"
COPY wanted.txt ./
RUN mkdir -p /opt/tools \
    && echo "$FLAVOUR $GREETING" > /opt/tools/made.txt && pwd > where.txt

FROM base AS runtime
COPY --from=packages /opt/tools /opt/tools
COPY --chown=10001:10001 folder ./folder
ENV HOME=/tmp
USER 10001:10001
HEALTHCHECK --interval=1s CMD ["python", "-c", "import os; open(os.environ['HOME'] + '/ready')"]
CMD ["python", "folder/service.py"]
"""

SERVICE = """
import os, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
{extra}
open(os.environ["HOME"] + "/ready", "w").close()
time.sleep(60)
"""


@pytest.fixture
def context(tmp_path: Path) -> Path:
    context = tmp_path / "context"
    (context / "folder" / "deep").mkdir(parents=True)
    (context / "Dockerfile").write_text(DOCKERFILE)
    (context / ".dockerignore").write_text("*\n!wanted.txt\n!folder\n**/*.pyc\n")
    (context / "wanted.txt").write_text("wanted")
    (context / "secret.txt").write_text("secret")
    (context / "folder" / "deep" / "stale.pyc").write_text("stale")
    (context / "folder" / "service.py").write_text(SERVICE.format(extra=""))
    return context


@pytest.fixture
def work(tmp_path: Path) -> Path:
    work = tmp_path / "work"
    work.mkdir()
    return work


def test_stages_are_built_from_their_bases_with_paths_moved(context: Path, work: Path) -> None:
    replay = Replay(context, work, {})
    runtime = replay.build("runtime")

    made = runtime.root / "opt" / "tools" / "made.txt"
    assert made.read_text() == "plain hello there\n"
    assert (work / "packages" / "srv" / "thing" / "where.txt").read_text().strip() == str(
        work / "packages" / "srv" / "thing"
    )
    assert (work / "packages" / "srv" / "thing" / "wanted.txt").read_text() == "wanted"
    assert runtime.environment["PATH"].startswith(f"{runtime.root}/opt/tools:")
    assert runtime.environment["HOME"] == f"{runtime.root}/tmp"
    assert "FLAVOUR" not in runtime.environment
    assert runtime.user == "10001:10001"
    assert not list(runtime.root.rglob("*.pyc"))
    assert not list(runtime.root.rglob("wanted.txt"))


def test_build_arguments_replace_defaults(context: Path, work: Path) -> None:
    packages = Replay(context, work, {"FLAVOUR": "spicy"}).build("packages")
    assert (packages.root / "opt/tools/made.txt").read_text() == "spicy hello there\n"


def test_copy_refuses_what_the_build_context_leaves_out(context: Path, work: Path) -> None:
    text = DOCKERFILE.replace("COPY wanted.txt", "COPY secret.txt")
    (context / "Dockerfile").write_text(text)
    with pytest.raises(ReplayError, match=r"COPY secret\.txt: .*\.dockerignore"):
        Replay(context, work, {}).build("runtime")


def test_a_failing_step_is_named(context: Path, work: Path) -> None:
    (context / "Dockerfile").write_text("FROM x AS only\nRUN exit 7\n")
    with pytest.raises(ReplayError, match=r"exit status 7 .*exit 7"):
        Replay(context, work, {}).build("only")


def test_an_unknown_instruction_is_refused() -> None:
    with pytest.raises(ReplayError, match="ONBUILD"):
        parse("FROM x\nONBUILD RUN true\n")


def test_service_is_started_found_healthy_and_stopped(
    context: Path, work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work.chmod(0o755)
    replay = Replay(context, work, {})
    serve(replay, replay.build("runtime"), port=1, patience=20, stay=False)
    assert "healthy after" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        ("sys.exit(3)", "ended with status 3"),
        ("time.sleep(60)", "not healthy within 1 s"),
        ("open('folder/trace', 'w').close()", r"could not be written: .*folder/trace"),
    ],
)
def test_a_service_that_would_fail_in_a_container_fails_here(
    context: Path, work: Path, extra: str, reason: str
) -> None:
    if os.geteuid() == 0:
        # As root the replay changes to the image's user where it can; let it write all the same.
        (context / "Dockerfile").write_text(DOCKERFILE.replace("USER 10001:10001", "USER 0:0"))
    (context / "folder" / "service.py").write_text(SERVICE.format(extra=extra))
    replay = Replay(context, work, {})
    stage = replay.build("runtime")
    patience = 1 if "not healthy" in reason else 20
    with pytest.raises(ReplayError, match=reason):
        serve(replay, stage, port=1, patience=patience, stay=False)


@pytest.mark.parametrize(
    ("path", "ignored"),
    [
        ("app/main.py", False),
        ("app/deep/er/x.py", False),
        ("app/deep/__pycache__/x.cpython-311.pyc", True),
        ("app/.numba_cache/loops-0123456789abcdef/app/x.nbc", True),
        (".numba_cache/loops-0123456789abcdef/app/x.nbc", True),
        ("application/main.py", True),
        (".git/config", True),
        ("requirements.lock", False),
        ("requirements-dev.lock", True),
        ("tests/conftest.py", True),
    ],
)
def test_the_build_context_holds_what_the_image_needs(
    repository: Path, path: str, ignored: bool
) -> None:
    rules = ignore_rules((repository / ".dockerignore").read_text("utf-8"))
    assert is_ignored(path, rules) is ignored
