"""Weights of groups on segments, against a loop over keys."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.strategies import episode_tokens, groupings
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.segments import segment_members, segments_of, weights_on_segments


def by_loop(weights: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    replans = max(len(weights), len(members))
    found = np.zeros((replans, members.shape[2], weights.shape[2]), np.float32)
    cut = np.zeros(found.shape[1:], bool)
    for replan in range(replans):
        own, inside = weights[min(replan, len(weights) - 1)], members[min(replan, len(members) - 1)]
        for segment in range(members.shape[2]):
            for group in range(weights.shape[2]):
                values = {float(value) for value in own[inside[:, segment], group]}
                cut[segment, group] |= len(values) > 1
                found[replan, segment, group] = max(values, default=0.0)
    return np.where(cut, 0.0, found), cut


@given(data=st.data())
def test_weights_on_segments_are_those_of_a_loop_over_keys(data):
    tokens = data.draw(episode_tokens())
    roles = tokens.static_roles
    members = segment_members(tokens.layout, roles, segments_of(tokens.layout, roles))
    weights = resolve(data.draw(groupings(tokens)), tokens).weights
    (found, cut), (expected, is_cut) = weights_on_segments(weights, members), by_loop(weights, members)
    np.testing.assert_array_equal(cut, is_cut)
    np.testing.assert_array_equal(found, expected)


def test_a_group_that_cuts_a_segment_at_the_last_replan_alone_is_noticed():
    members = np.zeros((3, 4, 2), bool)
    members[:, :2, 0] = members[:, 2:, 1] = True
    weights = np.zeros((3, 4, 1), np.float32)
    weights[:, :2] = 1.0
    assert not weights_on_segments(weights, members)[1].any()
    weights[2, 3] = 1.0
    assert weights_on_segments(weights, members)[1].tolist() == [[False], [True]]
