"""Audit the code and its locked packages: known vulnerabilities, risky code, a bill of materials.

Usage: python scripts/audit.py [--may-be-unreachable]   (or `make audit`)

Exit status: 0 everything was looked at and nothing found; 1 something was found, or a part failed;
3 nothing was found, but a part was NOT RUN because no advisory service answered. With
--may-be-unreachable that, too, is 0; the last line says NOT RUN all the same.
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
LOCKS = ("requirements.lock", "requirements-training.lock", "requirements-dev.lock")
# What the two images hold; development tools are shipped nowhere.
SHIPPED = {"service": "requirements.lock", "training": "requirements-training.lock"}
SOURCES = ("app", "training")
BILLS = ROOT / "build"

# Asked in turn until one of them answers as an advisory service does.
SERVICES = ("pypi", "osv")
# Vulnerable for good (CVE-2019-10906). A package index that knows no advisories answers without
# any, and pip-audit takes that, and even "no such package", for "no known vulnerabilities": so
# an answer about the locks counts only where this one is known.
CANARY = "jinja2==2.10"


class Verdict(Enum):
    """How a part of the audit ended."""

    OK = "ok"
    FOUND = "FOUND"
    NOT_RUN = "NOT RUN"


@dataclass(frozen=True, slots=True)
class Outcome:
    """A verdict and, line by line, what it rests on."""

    verdict: Verdict
    lines: tuple[str, ...]


def run(*command: str) -> subprocess.CompletedProcess[str]:
    """A tool of this environment, run from the repository's root."""
    return subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )


def judge(output: str, trouble: str, required: set[str]) -> Outcome:
    """What a run of pip-audit means.

    Args:
        output: its standard output, JSON where it got an answer for every package.
        trouble: its standard error.
        required: names of the packages it was to look at.
    """
    try:
        entries = json.loads(output)["dependencies"]
    except (ValueError, KeyError, TypeError):
        last = trouble.strip().splitlines()[-1:] or ["no answer"]
        return Outcome(Verdict.NOT_RUN, (last[0][:200],))
    found = sorted(
        f"{entry['name']} {entry['version']}: {flaw['id']}"
        + (f", fixed in {', '.join(flaw['fix_versions'])}" if flaw["fix_versions"] else "")
        for entry in entries
        for flaw in entry.get("vulns", ())
    )
    looked_at = {entry["name"] for entry in entries if "vulns" in entry}
    unknown = sorted(required - looked_at)
    if found:
        return Outcome(Verdict.FOUND, tuple(found))
    if unknown:
        return Outcome(Verdict.NOT_RUN, (f"no answer about {', '.join(unknown)}",))
    return Outcome(Verdict.OK, (f"no known vulnerability in {len(looked_at)} packages",))


def ask(service: str, *arguments: str) -> tuple[str, str]:
    """Output and error of pip-audit over pinned requirements, which it is not to resolve."""
    fixed = ("--no-deps", "--disable-pip", "--progress-spinner=off", "--format=json")
    done = run("pip_audit", f"--vulnerability-service={service}", *fixed, *arguments)
    return done.stdout, done.stderr


def knows_advisories(service: str) -> Outcome:
    """`FOUND` where the service knows of a flaw that everybody knows of."""
    canary = BILLS / "canary.txt"
    canary.write_text(CANARY + "\n", "utf-8")
    outcome = judge(*ask(service, f"--requirement={canary}"), {CANARY.partition("==")[0]})
    if outcome.verdict is Verdict.OK:
        return Outcome(Verdict.NOT_RUN, (f"it knows no advisory about {CANARY}",))
    return outcome


def pinned(lock: str) -> set[str]:
    """The names in a lock file that apply to this machine's platform."""
    lines = (ROOT / lock).read_text("utf-8").splitlines()
    apply = [line for line in lines if "==" in line and not line.startswith("#")]
    if sys.platform == "win32":
        apply = [line for line in apply if "sys_platform != 'win32'" not in line]
    return {line.partition("==")[0] for line in apply}


def advisories() -> Outcome:
    """Known vulnerabilities of everything in the lock files."""
    reasons = []
    for service in SERVICES:
        known = knows_advisories(service)
        if known.verdict is Verdict.FOUND:
            files = [f"--requirement={lock}" for lock in LOCKS]
            return judge(*ask(service, *files), set().union(*map(pinned, LOCKS)))
        reasons.append(f"{service}: {known.lines[0]}")
    return Outcome(Verdict.NOT_RUN, ("no advisory service could be reached", *reasons))


def risky_code() -> Outcome:
    """Bandit's findings in what is shipped, as pyproject.toml configures it."""
    done = run("bandit", "--quiet", "--configfile=pyproject.toml", "--recursive", *SOURCES)
    if done.returncode:
        return Outcome(Verdict.FOUND, tuple((done.stdout + done.stderr).strip().splitlines()))
    return Outcome(Verdict.OK, (f"nothing in {', '.join(SOURCES)}",))


def bills_of_materials() -> Outcome:
    """CycloneDX documents of what each image holds, checked against the format's schema."""
    lines = []
    for name, lock in SHIPPED.items():
        bill = BILLS / f"sbom-{name}.cdx.json"
        done = run(
            *("cyclonedx_py", "requirements", lock, "--pyproject=pyproject.toml"),
            *("--output-reproducible", "--validate", f"--output-file={bill}"),
        )
        if done.returncode:
            return Outcome(Verdict.FOUND, (f"{lock}: {done.stderr.strip()[-300:]}",))
        held = {component["name"] for component in json.loads(bill.read_text())["components"]}
        if missing := sorted(pinned(lock) - held):
            return Outcome(Verdict.FOUND, (f"{lock}: not in the bill: {', '.join(missing)}",))
        lines.append(f"{bill.name}: {len(held)} packages")
    return Outcome(Verdict.OK, tuple(lines))


def exit_status(verdicts: list[Verdict], *, may_be_unreachable: bool) -> int:
    """What the audit as a whole comes to."""
    if Verdict.FOUND in verdicts:
        return 1
    return 3 if Verdict.NOT_RUN in verdicts and not may_be_unreachable else 0


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--may-be-unreachable",
        action="store_true",
        help="exit with 0 where no advisory service answers",
    )
    options = parser.parse_args(arguments)
    BILLS.mkdir(exist_ok=True)
    parts = {
        "risky code": risky_code,
        "bills of materials": bills_of_materials,
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
