"""Seeds of the noise: one for every replan, from its place alone."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from vla_attention.capture.policies.noise import initial_noise, noise_seed
from vla_attention.capture.policies.pi.embedded import dummy_policy


def test_every_place_has_a_seed_of_its_own():
    """Run, task, episode and replan each make a difference, and no two of them may change places."""
    places = list(product(range(4), repeat=4))
    seeds = [noise_seed(*place) for place in places]
    assert len(set(seeds)) == len(places)
    assert seeds == [noise_seed(*place) for place in places]
    assert all(0 <= seed < 2**63 for seed in seeds)


@pytest.mark.parametrize("which", range(4), ids=["run", "task", "episode", "replan"])
def test_pi_draws_other_noise_where_one_number_of_the_place_differs(which):
    policy, place = dummy_policy(), [3, 2, 1, 0]
    seeds = []
    for number in range(5):
        place[which] = number
        seeds.append(policy.replan_noise_seed(*place))
        assert seeds[-1] == noise_seed(*place)
    drawn = [initial_noise(seed, (2, 3)) for seed in seeds]
    assert len({noise.tobytes() for noise in drawn}) == len(seeds)
    np.testing.assert_array_equal(drawn[0], initial_noise(seeds[0], (2, 3)))
