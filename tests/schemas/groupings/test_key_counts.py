"""Keys that come and go: the baseline is the mass that attention gives which is uniform over the keys of each query."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.schemas.groupings.key_counts import key_counts, num_valid_keys
from vla_attention.schemas.layout import INVALID_ROLES, Role, SiteLayout, Span
from vla_attention.testing import small_tokens

IMAGE, ABSENT, PADDING, ACTION = (int(role) for role in (Role.IMAGE, Role.ABSENT, Role.PADDING, Role.ACTION))


def layout(offset: int = 0) -> SiteLayout:
    grown = Span("generated", "action", 5, 9, growing=True, growing_offset=offset)
    return SiteLayout("joint", (Span("image", "image", 0, 3), Span("prompt", "text", 3, 5), grown))


def uniform_mass(site: SiteLayout, roles: list[int], num_queries: int) -> np.ndarray:
    """Mean mass (key,) under uniform attention, query by query."""
    span = site.growing_span
    queries = num_queries - sum(roles[key] == ABSENT for key in range(span.start, span.stop))
    mass = np.zeros(len(roles))
    for query in range(queries):
        seen = [
            key
            for key, role in enumerate(roles)
            if role not in INVALID_ROLES and (key < span.start or key - span.start < query + span.growing_offset)
        ]
        mass[seen] += 1 / len(seen) / queries
    return mass


@pytest.mark.parametrize("offset", [0, 1, 2])
@pytest.mark.parametrize(
    "roles",
    [
        [IMAGE] * 5 + [ACTION] * 4,
        [IMAGE] * 3 + [IMAGE, PADDING] + [ACTION] * 4,
        [IMAGE] * 3 + [IMAGE, ABSENT] + [ACTION] * 2 + [ABSENT] * 2,
    ],
)
def test_shares_of_keys_are_those_of_uniform_attention(roles, offset):
    site = layout(offset)
    key_role = np.array([roles], dtype=np.uint8)
    valid = ~np.isin(key_role, INVALID_ROLES)
    counts = key_counts(site, key_role, valid, num_queries=5)
    expected = uniform_mass(site, roles, 5)
    np.testing.assert_allclose((counts * valid)[0] / num_valid_keys(valid, counts)[0], expected, rtol=1e-12)
    assert (counts[0, :3] == 1).all(), "a key that all queries see counts for one"
    assert (counts[key_role == ABSENT] == 0).all()


def test_usual_keys_count_for_one_each():
    tokens = small_tokens(3, 0, [0])
    assert tokens.key_counts is None
    assert num_valid_keys(tokens.valid, None).dtype == np.int64


def test_absent_keys_count_for_none():
    site = SiteLayout("joint", (Span("prompt", "text", 0, 3),))
    roles = np.array([[Role.TEXT, Role.TEXT, Role.TEXT], [Role.TEXT, Role.TEXT, Role.ABSENT]], dtype=np.uint8)
    valid = ~np.isin(roles, INVALID_ROLES)
    counts = key_counts(site, roles, valid, num_queries=4)
    assert counts.tolist() == [[1, 1, 1], [1, 1, 0]]
    assert num_valid_keys(valid, counts).tolist() == [3, 2]
