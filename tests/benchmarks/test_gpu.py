"""`benchmarks/gpu.py` without a GPU, and the parts of it that need none."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from benchmarks.capture_overhead import KINDS, USUAL, calls_of, usual_way
from benchmarks.measurement import ROOT
from tests.kit.policy_inputs import KeepAll, make_observation
from vla_attention.capture.policies.pi.embedded import dummy_policy


@pytest.mark.thorough
def test_without_a_gpu_it_says_so_and_ends_with_2():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("No GPU: ")
    assert "Traceback" not in done.stderr


def test_the_usual_way_keeps_every_matrix_of_the_rows_that_we_record():
    policy, kept = dummy_policy(), []
    given = policy.prepare(make_observation(0), "lift")
    collector = KeepAll()
    expected = policy.act(given, 0, {"joint": collector})
    with usual_way(kept):
        actions = policy.act(given, 0)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
    depth, steps = 3, 3
    assert len(kept) == depth - 1 + steps * depth  # the last block of the prefix reads nothing
    last = kept[depth - 1 :]
    for step in range(steps):
        for layer in range(depth):
            wanted = collector.rows[layer, step].numpy()
            np.testing.assert_allclose(last[step * depth + layer], wanted, rtol=0, atol=1e-5)


def test_there_is_a_call_for_every_kind():
    policy = dummy_policy()
    policy.num_denoise_steps = 10
    assert list(calls_of(policy)) == ["plain", *KINDS, USUAL]
