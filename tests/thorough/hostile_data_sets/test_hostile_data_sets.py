"""Data sets from anybody: each attack ends with its sentence, exit code 2, and little memory and time."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from typing import Any

import pytest

from tests.kit.thorough import asked_for
from tests.thorough.hostile_data_sets.run_cases import CASES, GOOD
from vla_attention.schemas.bounded_process import MOST_BYTES

#: Processor time that a refusal may take beyond start-up.
MOST_SECONDS = 5.0


@pytest.fixture(scope="session")
def results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """The cases that this session asks for, run in one process that forks."""
    names = [*GOOD, *asked_for(request, "name", CASES)]
    folder = tmp_path_factory.mktemp("hostile")
    command = [sys.executable, "-m", "tests.thorough.hostile_data_sets.run_cases", str(folder), *names]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    shutil.rmtree(folder, ignore_errors=True)
    found = [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    assert len(found) == len(names), ran.stderr[-3000:]
    return {result["name"]: result for result in found}


@pytest.mark.parametrize("name", GOOD)
def test_the_data_sets_themselves_are_replayed(results, name):
    assert (results[name]["code"], results[name]["episodes"]) == (0, 1), results[name]


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_data_set_is_refused_with_a_sentence(results, name):
    result = results[name]
    said = result["output"].strip()
    assert result["code"] == 2, result
    assert "Traceback" not in said
    assert "panicked" not in said
    refusals = [line for line in said.split("\n") if line.startswith("vla-attention capture")]
    assert len(refusals) == 1, said
    assert re.search(CASES[name].sentence, refusals[0]), refusals[0]
    assert all(line.isprintable() for line in said.split("\n"))
    assert len(said) < 15_000
    assert result["episodes"] == 0
    # The model is built for those whose pictures are wrong; the time for it is that of a data set that is replayed.
    # A processor that others use too takes longer for the same work, so that a refusal may take a few times as long.
    usual = min(results[good]["processor_seconds"] for good in GOOD)
    assert result["processor_seconds"] < 3 * usual + MOST_SECONDS
    assert result["bytes"] < MOST_BYTES
