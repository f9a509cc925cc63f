"""`make audit`: what it says where a database answers, and where none does."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "audit.py"
#: A pip-audit that answers for one database only, from a file beside it.
PROGRAM = """#!{python}
import json, pathlib, sys
given = sys.argv[1:]
here = pathlib.Path(__file__).parent
if given[given.index("--vulnerability-service") + 1] != (here / "answers").read_text():
    sys.exit("ERROR:pip_audit: no connection")
names = pathlib.Path(given[given.index("--requirement") + 1]).read_text().split()
known = json.loads((here / "known.json").read_text())
if "skip" in known:
    entries = [dict(name="pip", skip_reason="not found")]
else:
    pairs = [name.split("==") for name in names]
    entries = [dict(name=name, version=version, vulns=known.get(name, [])) for name, version in pairs]
pathlib.Path(given[given.index("--output") + 1]).write_text(json.dumps(dict(dependencies=entries)))
sys.exit(1 if known else 0)
"""


@pytest.fixture
def audit(tmp_path):
    program = tmp_path / "pip-audit"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)

    def run(answers, known):
        (tmp_path / "answers").write_text(answers)
        (tmp_path / "known.json").write_text(json.dumps(known))
        command = [sys.executable, str(SCRIPT), "--program", str(program)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    return run


def test_without_a_database_nothing_was_compared(audit):
    ran = audit("nobody", {})
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert "pypi: " in ran.stderr
    ran = audit("pypi", {"skip": []})
    assert ran.returncode == 2
    assert re.search("pypi: .* pip==", ran.stderr)


@pytest.mark.parametrize("service", ["pypi", "osv"])
def test_what_is_known_is_listed(audit, service):
    ran = audit(service, {"numpy": [{"id": "PYSEC-1", "fix_versions": ["9.9"]}]})
    assert ran.returncode == 1
    assert re.search(r"PYSEC-1; .*9\.9", ran.stdout)
    assert re.search(rf"{service}: 1 ", ran.stdout)
    assert audit(service, {}).returncode == 0
