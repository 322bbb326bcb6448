"""The audit reports databases that give no answer. Bills of materials have every package."""

import json
from functools import partial
from typing import Any

import pytest

from app import __version__
from scripts import audit, sbom
from scripts.audit import Outcome, Verdict, judge

pytestmark = pytest.mark.system

NOTHING = "No known vulnerabilities found"
FLAW = {"id": "PYSEC-2019-217", "fix_versions": ["2.10.1"], "aliases": [], "description": ""}


def report(*entries: dict[str, Any]) -> str:
    """What pip-audit writes with --format=json."""
    return json.dumps({"dependencies": list(entries), "fixes": []})


def package(kind: str, name: str) -> dict[str, Any]:
    if kind == "skipped":
        return {"name": name, "skip_reason": f"Dependency not found on PyPI: {name} (1.0)"}
    return {"name": name, "version": "2.10", "vulns": [FLAW] if kind == "flawed" else []}


sound, flawed, skipped = (partial(package, kind) for kind in ("sound", "flawed", "skipped"))


def test_flaws_have_a_fixed_version() -> None:
    outcome = judge(report(sound("a"), sound("b")), "", {"a", "b"})
    assert outcome == Outcome(Verdict.OK, ("no known vulnerability in 2 packages",))
    outcome = judge(report(sound("a"), flawed("b"), skipped("c")), "", {"a", "b", "c"})
    assert outcome == Outcome(Verdict.FOUND, ("b 2.10: PYSEC-2019-217, fixed in 2.10.1",))


@pytest.mark.parametrize(
    ("output", "trouble", "reason"),
    [
        # A mirror without the index's JSON pages: pip-audit exits with 0.
        (report(skipped("a"), skipped("b")), NOTHING, "packages a, b"),
        (report(sound("a"), skipped("b")), NOTHING, "packages b"),
        (report(sound("a")), NOTHING, "packages b"),
        (report(), NOTHING, "packages a, b"),
        # No name resolution: a traceback, and nothing on standard output.
        ("", "Traceback (most recent call last):\n  ...\nConnectionError: failed", "Connection"),
        ("", "ERROR:pip_audit._cli:Tip: your network may be blocking this service.", "blocking"),
        ("", "", "no answer"),
        ("<html>Sign in</html>", "", "no answer"),
        ("[]", "", "no answer"),
    ],
)
def test_missing_answers_are_not_run(output: str, trouble: str, reason: str) -> None:
    outcome = judge(output, trouble, {"a", "b"})
    assert outcome.verdict is Verdict.NOT_RUN
    assert reason in outcome.lines[0]


@pytest.mark.parametrize(
    ("answers", "verdict", "lock_services"),
    [
        # Only a service that knows the canary's flaw is asked about the locks.
        ({"pypi": flawed, "osv": flawed}, Verdict.OK, ["pypi"]),
        ({"pypi": sound, "osv": flawed}, Verdict.OK, ["osv"]),
        ({"pypi": skipped, "osv": flawed}, Verdict.OK, ["osv"]),
        ({"pypi": skipped, "osv": sound}, Verdict.NOT_RUN, []),
    ],
)
def test_a_database_needs_the_canary(monkeypatch, tmp_path, answers, verdict, lock_services):
    services = []

    def ask(service: str, *arguments: str) -> tuple[str, str]:
        if any("canary" in argument for argument in arguments):
            return report(answers[service]("jinja2")), ""
        services.append(service)
        return report(*map(sound, audit.names(*audit.LOCKS))), ""

    monkeypatch.setattr(audit, "ask", ask)
    monkeypatch.setattr(audit, "WORK", tmp_path)
    assert audit.advisories().verdict is verdict
    assert services == lock_services


@pytest.mark.parametrize("name", ["service", pytest.param("training", marks=pytest.mark.slow)])
def test_a_bill_has_the_versions_and_hashes_of_the_locks(monkeypatch, tmp_path, name) -> None:
    monkeypatch.setattr(sbom, "BILLS", tmp_path)
    bill = json.loads(sbom.bill_of_materials(name).read_text("utf-8"))
    assert bill["bomFormat"] == "CycloneDX"
    assert bill["metadata"]["component"]["version"] == __version__
    components = {f"{one['name']}=={one['version']}": one for one in bill["components"]}
    assert components.keys() == set(audit.pinned(*sbom.SHIPPED[name]))
    for pin, component in components.items():
        references = component.get("externalReferences", [{}])
        assert any("hashes" in one for one in references) or pin.startswith("torch=="), pin
