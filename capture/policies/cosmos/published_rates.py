"""Published success rates of checkpoints of this family, for `vla-capture doctor --accept`."""

from __future__ import annotations

from vla_attention.capture.policies.family import PublishedRate

CHECKPOINT = "nvidia/Cosmos-Policy-LIBERO-Predict2-2B"
_SOURCE = "config.json of the checkpoint's repository, and arXiv:2601.16163"
#: Per cent by suite. Counted as one evaluation of 50 episodes of each of the ten tasks.
_RATES = {"libero_spatial": 98.1, "libero_object": 100.0, "libero_goal": 98.2, "libero_10": 97.6}

PUBLISHED_RATES = tuple(
    PublishedRate(CHECKPOINT, suite, round(5 * rate), 500, _SOURCE) for suite, rate in _RATES.items()
)
