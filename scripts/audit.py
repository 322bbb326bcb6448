"""Audit the code and its locked packages: known vulnerabilities, risky code.

Usage: python scripts/audit.py [--may-be-unreachable]   (or `make audit`)

Exit status:

    0   all parts of the audit ran without findings
    1   a part has findings or failed
    3   a part did not run, because no vulnerability database answered. With --may-be-unreachable,
        the status is 0 instead, and the last line of the output still says NOT RUN
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCKS = (
    *("requirements.lock", "requirements-training.lock", "requirements-dev.lock"),
    "requirements-torch.lock",
)
SOURCES = ("app", "training")
WORK = ROOT / "build"

# Vulnerability databases that pip-audit can query. The first one that works is used.
SERVICES = ("pypi", "osv")
# Package version with a known vulnerability (CVE-2019-10906). A package index without advisories
# returns an empty list, and pip-audit then reports "no known vulnerabilities". A database therefore
# counts as working only if it reports this vulnerability.
CANARY = "jinja2==2.10"


class Verdict(Enum):
    """Result of one part of the audit."""

    OK = "ok"
    FOUND = "FOUND"
    NOT_RUN = "NOT RUN"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one part of the audit.

    Attributes:
        verdict: result of the part.
        lines: reasons for the result, one per line.
    """

    verdict: Verdict
    lines: tuple[str, ...]


def run(*command: str) -> subprocess.CompletedProcess[str]:
    """Run a Python module (`python -m`) in the root of the repository."""
    return subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )


def judge(output: str, trouble: str, required: set[str]) -> Outcome:
    """Interpret the output of pip-audit.

    Args:
        output: standard output of pip-audit. It is JSON if every package was checked.
        trouble: standard error of pip-audit.
        required: names of the packages to check.
    """
    try:
        entries = json.loads(output)["dependencies"]
    except (ValueError, KeyError, TypeError):
        last = trouble.strip().splitlines()[-1:] or ["no answer"]
        return Outcome(Verdict.NOT_RUN, (last[0][:200],))
    flaws = sorted(
        f"{entry['name']} {entry['version']}: {flaw['id']}"
        + (f", fixed in {', '.join(flaw['fix_versions'])}" if flaw["fix_versions"] else "")
        for entry in entries
        for flaw in entry.get("vulns", ())
    )
    looked_at = {entry["name"] for entry in entries if "vulns" in entry}
    unknown = sorted(required - looked_at)
    if flaws:
        return Outcome(Verdict.FOUND, tuple(flaws))
    if unknown:
        return Outcome(Verdict.NOT_RUN, (f"no answer about the packages {', '.join(unknown)}",))
    return Outcome(Verdict.OK, (f"no known vulnerability in {len(looked_at)} packages",))


def ask(service: str, *arguments: str) -> tuple[str, str]:
    """Run pip-audit on pinned requirements. Return its standard output and standard error."""
    fixed = ("--no-deps", "--disable-pip", "--progress-spinner=off", "--format=json")
    done = run("pip_audit", f"--vulnerability-service={service}", *fixed, *arguments)
    return done.stdout, done.stderr


def knows_advisories(service: str) -> Outcome:
    """Return `FOUND` if the vulnerability database reports the vulnerability of `CANARY`."""
    canary = WORK / "canary.txt"
    canary.write_text(CANARY + "\n", "utf-8")
    outcome = judge(*ask(service, f"--requirement={canary}"), {CANARY.partition("==")[0]})
    if outcome.verdict is Verdict.OK:
        return Outcome(Verdict.NOT_RUN, (f"the database has no advisory about {CANARY}",))
    return outcome


def pinned(*locks: str) -> list[str]:
    """Return the lines `name==version` of the packages in lock files that this platform needs."""
    lines = [line for lock in locks for line in (ROOT / lock).read_text("utf-8").splitlines()]
    apply = [line for line in lines if "==" in line and not line.startswith("#")]
    if sys.platform == "win32":
        apply = [line for line in apply if 'sys_platform != "win32"' not in line]
    return sorted({line.partition(" ")[0] for line in apply})


def names(*locks: str) -> set[str]:
    """Return the names of the packages in lock files that this platform needs."""
    return {line.partition("==")[0] for line in pinned(*locks)}


def without_hashes(*locks: str) -> Path:
    """Write the packages of several lock files to one file, and return its path."""
    path = WORK / "packages.txt"
    path.write_text("\n".join(pinned(*locks)) + "\n", "utf-8")
    return path


def advisories() -> Outcome:
    """Check all packages of the lock files for known vulnerabilities."""
    reasons = []
    for service in SERVICES:
        outcome = knows_advisories(service)
        if outcome.verdict is Verdict.FOUND:
            return judge(*ask(service, f"--requirement={without_hashes(*LOCKS)}"), names(*LOCKS))
        reasons.append(f"{service}: {outcome.lines[0]}")
    return Outcome(Verdict.NOT_RUN, ("all vulnerability databases failed", *reasons))


def risky_code() -> Outcome:
    """Run bandit on the shipped code, configured by pyproject.toml."""
    done = run("bandit", "--quiet", "--configfile=pyproject.toml", "--recursive", *SOURCES)
    if done.returncode:
        return Outcome(Verdict.FOUND, tuple((done.stdout + done.stderr).strip().splitlines()))
    return Outcome(Verdict.OK, (f"no findings in {', '.join(SOURCES)}",))


def exit_status(verdicts: list[Verdict], *, may_be_unreachable: bool) -> int:
    """Return the exit status of the whole audit, from the results of its parts."""
    if Verdict.FOUND in verdicts:
        return 1
    return 3 if Verdict.NOT_RUN in verdicts and not may_be_unreachable else 0


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--may-be-unreachable",
        action="store_true",
        help="exit with status 0 if no vulnerability database answers",
    )
    options = parser.parse_args(arguments)
    WORK.mkdir(exist_ok=True)
    parts = {
        "risky code": risky_code,
        "known vulnerabilities": advisories,
    }
    outcomes = {}
    for name, part in parts.items():
        outcomes[name] = part()
        print(f"{name}: {outcomes[name].verdict.value}")
        for line in outcomes[name].lines:
            print(f"    {line}")
    verdicts = [outcome.verdict for outcome in outcomes.values()]
    summary = ", ".join(f"{name} {outcome.verdict.value}" for name, outcome in outcomes.items())
    print(f"audit: {summary}", flush=True)
    return exit_status(verdicts, may_be_unreachable=options.may_be_unreachable)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
