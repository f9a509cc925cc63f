"""Cosmos Policy's own LIBERO evaluation, `run_libero_eval.py`."""

from __future__ import annotations

from vla_attention.capture.environments.episode_protocol import EvaluationProtocol

# In its deterministic mode, the default, it seeds everything with 0 before every step of an episode. No step draws a
# random number, so every reset begins with that seed too.
COSMOS = EvaluationProtocol("cosmos", image_size=256, seeding="always 0", default_seed=7)
