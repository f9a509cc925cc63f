"""Which policy ran: the part of a policy's provenance that two episodes of one run must share."""

from __future__ import annotations

from vla_attention.capture.policies.base import Policy
from vla_attention.schemas.stores.store_format import PolicyCameraView, PolicyIdentity

#: Named fields of `PolicyIdentity`, or facts of the machine and not of the policy.
_NOT_CONFIG = ("policy", "family", "checkpoint", "checkpoint_format", "weights_digest", "untrained", "device")


def identify(policy: Policy) -> PolicyIdentity:
    """Describe a policy for the store's root attributes. Hashes all weights the first time."""
    facts = policy.provenance()
    return PolicyIdentity(
        name=policy.name,
        family=facts["family"],
        checkpoint=facts["checkpoint"],
        checkpoint_format=facts["checkpoint_format"],
        digest=facts["weights_digest"],
        untrained=facts["untrained"],
        num_layers=policy.num_layers,
        num_heads=policy.num_heads,
        num_denoise_steps=policy.num_denoise_steps,
        action_horizon=policy.action_horizon,
        cameras=tuple(
            PolicyCameraView(
                name=camera.slot,
                source=camera.environment_camera,
                upright=camera.flip_rows,
                mirrored=camera.flip_columns,
                visible=camera.visible,
            )
            for camera in policy.cameras
        ),
        config={name: value for name, value in facts.items() if name not in _NOT_CONFIG},
    )
