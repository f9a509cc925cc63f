"""The embedded policy: it is reproducible, has the reference's layout, and its attention has structure."""

import torch

from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, EMBEDDED_CONFIG, build_random_model
from vla_attention.capture.policies.pi.policy import site_layout
from vla_attention.capture.policies.weights import weights_digest

#: of EMBEDDED_CONFIG with seed 0; after a change, earlier stores cannot be compared with new ones
DIGEST = "52e970b88c6dc94d0d9dbf2bd2c15b2c836c48cbd384238e8482666954ed798b"


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
