"""Compare the installed packages with the databases of known vulnerabilities; `make audit` runs it.

    python scripts/audit.py --packages .venv/bin/python --program .venv-audit/bin/pip-audit

pip-audit asks for every package. Where neither database answers, this says so and ends with 2: nothing was compared,
which is not the same as nothing found. It ends with 1 when a package has a known vulnerability, else with 0.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: pip-audit's names of the databases, in the order in which they are asked: the Python Packaging Advisory Database at
#: PyPI, and OSV of Google, which has the same entries.
SERVICES = ("pypi", "osv")
#: Asked first, to learn whether a database answers; pip-audit itself tries every package in vain.
_PROBE = "pip==24.0"
_SECONDS = 600
#: What lists the packages of a Python; one that was installed from a folder or an address has a direct_url.json.
_LIST = """
from importlib.metadata import distributions
for found in distributions():
    if found.metadata["Name"] and not found.read_text("direct_url.json"):
        print(f"{found.metadata['Name']}=={found.version}")
"""


def installed(python: str) -> list[str]:
    """Return the packages of an environment as `NAME==VERSION`, without those that come from a folder or an address.

    The part of a version after + names a build (torch 2.9.0+cpu), which no database lists.
    """
    listed = subprocess.run([python, "-c", _LIST], capture_output=True, text=True, check=True).stdout
    return sorted({line.partition("+")[0] for line in listed.splitlines()})


def ask(program: str, service: str, packages: Sequence[str], folder: Path) -> list[dict[str, Any]] | str:
    """Return what a database knows of each package, or the last line of what pip-audit said when it got no answer."""
    wanted, answer = folder / "packages.txt", folder / "answer.json"
    wanted.write_text("\n".join(packages) + "\n", encoding="utf-8")
    answer.unlink(missing_ok=True)
    options = ["--no-deps", "--disable-pip", "--progress-spinner", "off", "--format", "json", "--output", str(answer)]
    try:
        ran = subprocess.run(
            [program, "--requirement", str(wanted), "--vulnerability-service", service, *options],
            capture_output=True,
            text=True,
            timeout=_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    try:
        found: list[dict[str, Any]] = json.loads(answer.read_text(encoding="utf-8"))["dependencies"]
    except (OSError, ValueError, KeyError, TypeError):
        lines = [line.strip() for line in ran.stderr.splitlines() if line.strip()]
        return lines[-1] if lines else f"exit code {ran.returncode}"
    return found


def report(service: str, found: Sequence[dict[str, Any]]) -> int:
    """Print what is known; returns 1 if a package has a vulnerability, else 0."""
    skipped = [entry["name"] for entry in found if entry.get("skip_reason")]
    hits = [(entry, known) for entry in found for known in entry.get("vulns", ())]
    for entry, known in hits:
        fixed = ", ".join(known.get("fix_versions") or ()) or "none yet"
        print(f"{entry['name']} {entry['version']}: {known['id']}; fixed in {fixed}")
    print(f"{len(found) - len(skipped)} packages compared with {service}: {len(hits)} known vulnerabilities.")
    if skipped:
        print(f"Not in the database: {', '.join(sorted(skipped))}.")
    return 1 if hits else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Ask the databases in turn until one answers."""
    parser = argparse.ArgumentParser(description="Compare installed packages with known vulnerabilities.")
    parser.add_argument("--packages", default=sys.executable, help="the Python whose packages are compared")
    parser.add_argument("--program", default="pip-audit", help="pip-audit")
    arguments = parser.parse_args(argv)
    silent = {}
    with tempfile.TemporaryDirectory() as folder:
        for service in SERVICES:
            answer = ask(arguments.program, service, [_PROBE], Path(folder))
            if not isinstance(answer, str) and any(entry.get("skip_reason") for entry in answer):
                answer = f"it does not know {_PROBE}"  # a mirror of the packages alone
            if not isinstance(answer, str):
                answer = ask(arguments.program, service, installed(arguments.packages), Path(folder))
            if not isinstance(answer, str):
                return report(service, answer)
            silent[service] = answer
    why = "; ".join(f"{service}: {said}" for service, said in silent.items())
    print(f"No advisory service is reachable from here, so nothing was compared ({why}).", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
