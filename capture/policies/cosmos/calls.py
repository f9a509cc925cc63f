"""The call that the published script's options choose. A call is one denoise evaluation."""

from __future__ import annotations

from vla_attention.capture.policies.cosmos.config import CosmosConfig
from vla_attention.capture.policies.cosmos.sampler import noise_levels
from vla_attention.schemas.errors import BadArgument


def select_call(config: CosmosConfig, prefer_s: int | None, prefer_call: str) -> int:
    """Return the denoise step that `--prefer-S` and `--prefer-call` choose.

    prefer_s: sequence length that the call must have; None takes any. prefer_call: `last` or `first` of those.
    Raises `BadArgument` when no call has that length.
    """
    if prefer_call not in ("last", "first"):
        raise BadArgument(f"Cannot use --prefer-call '{prefer_call}'; expected 'last' or 'first'.")
    count = len(noise_levels(config.sampler))
    length = config.frames.count * config.tokens_per_frame
    if prefer_s is not None and prefer_s != length:
        raise BadArgument(
            f"No call has --prefer-S {prefer_s}: all {count} calls of this policy have S = {length} "
            f"({config.frames.count} latent frames of {config.tokens_per_frame} tokens)."
        )
    return 0 if prefer_call == "first" else count - 1
