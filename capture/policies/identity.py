"""Which policy ran: where its weights come from, and its description in a store's root attributes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.stores.store_format import PolicyIdentity

if TYPE_CHECKING:
    from vla_attention.capture.policies.policy import Policy


@dataclass(frozen=True)
class PolicySource:
    """Where a policy's weights come from.

    checkpoint: a path, a name on a hub, or for random weights how they were drawn. untrained: the weights are random.
    configuration: what fixed the sizes and the layout: the checkpoint itself, a named configuration, a case.json.
    """

    name: str
    checkpoint: str
    checkpoint_format: str
    untrained: bool
    configuration: str = "built in"


def describe_policy(policy: Policy, source: PolicySource, digest: str, config: dict[str, Any]) -> PolicyIdentity:
    """Return a policy's identity for the store.

    digest: SHA-256 (hex) over the weights. config: what else tells policies of the family apart, as plain JSON values; two runs
    that differ in it are never merged.
    """
    return PolicyIdentity(
        name=policy.name,
        family=policy.family,
        checkpoint=source.checkpoint,
        checkpoint_format=source.checkpoint_format,
        digest=digest,
        untrained=source.untrained,
        num_layers=policy.num_layers,
        num_heads=policy.num_heads,
        num_denoise_steps=policy.num_denoise_steps,
        action_horizon=policy.action_horizon,
        cameras=policy.cameras,
        config={"configuration": source.configuration, **config},
    )
