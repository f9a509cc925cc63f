"""Checkpoints from anybody: each attack ends with its sentence, exit code 2, and little memory; nothing is executed."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from typing import Any

import pytest

from tests.kit.thorough import asked_for
from tests.thorough.hostile_checkpoints.cosmos_cases import EXECUTES
from tests.thorough.hostile_checkpoints.hostile_files import TRACE, executing_pickle
from tests.thorough.hostile_checkpoints.run_cases import CASES

#: Resident memory that a refusal may take beyond start-up.
MOST_BYTES = 500_000_000


@pytest.fixture(scope="session")
def results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """The cases that this session asks for, run in one process that forks."""
    names = asked_for(request, "name", CASES)
    folder = tmp_path_factory.mktemp("hostile")
    command = [sys.executable, "-m", "tests.thorough.hostile_checkpoints.run_cases", str(folder), *names]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    shutil.rmtree(folder, ignore_errors=True)
    found = [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    assert len(found) == len(names), ran.stderr[-3000:]
    return {result["name"]: result for result in found}


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_checkpoint_is_refused_with_a_sentence(results, name):
    result = results[name]
    said = result["output"].strip()
    assert result["code"] == 2, result
    assert "Traceback" not in said
    refusals = [line for line in said.split("\n") if line.startswith("vla-attention capture")]
    assert len(refusals) == 1, said
    assert re.search(CASES[name].sentence, refusals[0]), refusals[0]
    assert all(line.isprintable() for line in said.split("\n"))
    assert len(said) < 15_000
    assert not result["executed"]
    assert result["episodes"] == 0
    assert result["bytes"] < MOST_BYTES


def test_the_pickles_would_execute(tmp_path):
    """The attack is one: read without a check, it leaves its trace."""
    import pickle

    pickle.loads(executing_pickle(tmp_path))
    assert (tmp_path / TRACE).exists()
    (tmp_path / "case").mkdir()
    arguments = EXECUTES(tmp_path / "case")
    assert arguments[0] == "cosmos"
