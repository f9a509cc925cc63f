"""The embedded policy: it is reproducible, has the reference's layout, and its attention has structure."""

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from tests.kit.policy_inputs import make_observation
from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, EMBEDDED_CONFIG, build_random_model, builtin_stats
from vla_attention.capture.policies.pi.policy import site_layout
from vla_attention.capture.policies.weights import weights_digest
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan
from vla_attention.schemas.layout import Role

INSTRUCTION = "put the black bowl on the plate"
#: of EMBEDDED_CONFIG with seed 0; after a change, earlier stores cannot be compared with new ones
DIGEST = "52e970b88c6dc94d0d9dbf2bd2c15b2c836c48cbd384238e8482666954ed798b"
#: Floating point operations of a replan in products of matrices; they took 0.4 s and 15 ms of one processor.
OPERATIONS = {"embedded": 5_037_842_432, "dummy": 3_768_960}


def record(policy, observation, instruction=INSTRUCTION, seed=0):
    """Rows (layer, denoise, head, query, key) of all layers at the first and last denoise step, and the key roles."""
    plan = RecordingPlan(tuple(range(18)), (0, 9), tuple(range(8)), "all", "joint")
    recorder = AttentionRecorder(plan, policy.sites[0].num_keys)
    given = policy.prepare(observation, instruction)
    policy.act(given, seed, {"joint": recorder})
    return recorder.finish().rows, given.key_role["joint"]


def distance(one, other):
    """Mean total variation distance of two sets of rows."""
    return 0.5 * np.abs(one - other).sum(-1).mean()


def test_layout_is_that_of_pi05_libero(embedded):
    assert (embedded.num_layers, embedded.num_heads, embedded.num_denoise_steps) == (18, 8, 10)
    assert embedded.sites[0].num_keys == 978
    assert embedded.action_horizon == 10
    assert [span.num_keys for span in site_layout(EMBEDDED_CONFIG).spans] == [256, 256, 256, 200, 10]


def test_weights_are_reproducible(embedded):
    assert weights_digest(embedded.model) == DIGEST
    assert embedded.identity().checkpoint == "random weights, seed 0"


def test_weights_follow_the_seed_and_leave_the_global_generators_alone():
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one = weights_digest(build_random_model(DUMMY_CONFIG, 0))
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert weights_digest(build_random_model(DUMMY_CONFIG, 0)) == one
    assert weights_digest(build_random_model(DUMMY_CONFIG, 1)) != one


def test_rows_are_neither_uniform_nor_on_one_key(embedded, observation):
    rows, roles = record(embedded, observation)
    valid = int((~np.isin(roles, [Role.MASKED_IMAGE, Role.PADDING])).sum())
    entropy = -(rows * np.log(np.maximum(rows, 1e-30))).sum(-1)
    effective = np.exp(entropy)
    assert 20 < effective.mean() < 0.6 * valid
    per_head = effective.mean(axis=(0, 1, 3))
    assert per_head.max() > 2 * per_head.min()
    for role in (Role.IMAGE, Role.INSTRUCTION, Role.ACTION):
        share = rows[..., roles == role].sum(-1).mean(axis=(1, 2, 3))
        assert (share > 0.003).all()


@pytest.mark.thorough
def test_rows_depend_on_picture_words_noise_and_time(embedded, observation):
    rows, _ = record(embedded, observation)
    assert distance(rows, record(embedded, make_observation(9))[0]) > 0.1
    assert distance(rows, record(embedded, observation, "turn on the stove")[0]) > 0.1
    assert distance(rows, record(embedded, observation, seed=1)[0]) > 0.1
    assert distance(rows[:, 0], rows[:, 1]) > 0.1


@pytest.mark.thorough
def test_actions_stay_near_the_built_in_ranges(embedded, observation):
    stats = builtin_stats().actions
    chunks = np.stack([embedded.act(embedded.prepare(observation, INSTRUCTION), seed) for seed in range(3)])
    middle, half = stats.mean, (stats.q99 - stats.q01) / 2
    assert np.abs((chunks - middle) / half).mean() < 1.5


@pytest.mark.parametrize("name", OPERATIONS)
def test_a_replan_is_quick(request, observation, name):
    """Operations are counted: the time for them depends on the machine and on what else it does."""
    policy = request.getfixturevalue(name)
    given = policy.prepare(observation, INSTRUCTION)
    with FlopCounterMode(display=False) as counter:
        policy.act(given, 0)
    # The lower limit shows that the counter sees them.
    assert 0.8 * OPERATIONS[name] < counter.get_total_flops() < 1.2 * OPERATIONS[name]
