"""The identity of a policy: the source of its weights, and its description in a store's root attributes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.stores.store_format import PolicyIdentity

if TYPE_CHECKING:
    from vla_attention.capture.policies.policy import Policy


@dataclass(frozen=True)
class PolicySource:
    """The source of a policy's weights.

    checkpoint: a path, a name on a hub with the commit (`ORG/NAME@COMMIT`), or a description of random weights.
    untrained: the weights are random. configuration: the source of sizes and layout: the checkpoint itself, a named
    configuration, a case.json, in words. config_name: the name of that configuration, where it has one. options: others
    that the policy was loaded with and that a rerun needs. downloads: the commits of all files from the hub, for a
    store's provenance.
    """

    name: str
    checkpoint: str
    checkpoint_format: str
    untrained: bool
    configuration: str = "built in"
    config_name: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    downloads: Mapping[str, str] = field(default_factory=dict)


def describe_policy(policy: Policy, source: PolicySource, digest: str, config: dict[str, Any]) -> PolicyIdentity:
    """Return a policy's identity for the store.

    digest: SHA-256 (hex) over the weights. config: other properties of the policy, as plain JSON values; runs that
    differ in them are never merged.
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
        config={
            "configuration": source.configuration,
            **({"config_name": source.config_name} if source.config_name else {}),
            **source.options,
            **config,
        },
    )


def downloads_of(policy: object) -> dict[str, str]:
    """Return the commits of the files from the hub that a policy was built from, for a store's provenance."""
    source = getattr(policy, "source", None)
    return dict(source.downloads) if isinstance(source, PolicySource) else {}


def announcement(identity: PolicyIdentity) -> list[str]:
    """Return the lines with which a run says what it runs: the policy, and that its weights are random if they are."""
    lines = [
        f"Policy: {identity.name} ({identity.checkpoint_format}: {identity.checkpoint}), weights "
        f"{identity.digest[:12]}."
    ]
    if identity.untrained:
        lines.append(
            "These weights are random and UNTRAINED: the numbers show that the tool works, and say nothing about any "
            "policy."
        )
    return lines
