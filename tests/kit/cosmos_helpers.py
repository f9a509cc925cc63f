"""Helpers of the Cosmos tests: the folders of the golden cases, instructions, recorders of everything."""

from __future__ import annotations

from tests.kit.paths import GOLDEN as ALL_GOLDEN
from tests.kit.paths import SHARED
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.schemas.stores.store_format import Recording

GOLDEN = ALL_GOLDEN / "cosmos"
#: Larger cases, too large for the repository.
LARGE_GOLDEN = SHARED / "golden" / "cosmos"
INSTRUCTION, OTHER_INSTRUCTION = "pick up the black bowl", "open the top drawer of the cabinet"


def recorders_of(policy, prepared):
    """Recorders of both sites as a rollout makes them: all layers, heads and denoise steps, with contributions."""
    layers, steps = tuple(range(policy.num_layers)), tuple(range(policy.num_denoise_steps))
    recording = Recording(
        layers=layers,
        layer_labels=layers,
        denoise_steps=steps,
        heads=tuple(range(policy.num_heads)),
        queries="mean",
        num_action_queries=policy.num_action_queries,
        mantissa_bits=23,
        contributions=True,
    )
    return make_recorders(recording, policy.sites, prepared.key_role)
