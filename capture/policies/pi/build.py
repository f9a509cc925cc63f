"""From what a user names on the command line to a pi policy."""

from __future__ import annotations

from pathlib import Path

from capture.policies.pi.checkpoint import detect_format
from capture.policies.pi.config import GEMMA_VARIANTS, GemmaConfig, find_variant
from capture.policies.pi.embedded import dummy_policy, embedded_policy
from capture.policies.pi.policy import PiPolicy, load_pi_policy
from schemas.errors import BadArgument, listing


def build_pi_policy(
    checkpoint: str,
    *,
    tokenizer: str | None,
    device: str,
    paligemma_variant: str | None = None,
    action_expert_variant: str | None = None,
    num_image_tokens: int | None = None,
) -> PiPolicy:
    """Build the policy and hold it against what the user says about it.

    `checkpoint` is a folder, or one of the two untrained policies that come with the package: `embedded`, `dummy`.
    Raises `BadArgument` when a variant or the number of image tokens contradicts the policy.
    """
    wanted = {
        "--paligemma-variant": find_variant(paligemma_variant) if paligemma_variant else None,
        "--action-expert-variant": find_variant(action_expert_variant) if action_expert_variant else None,
    }
    if checkpoint == "embedded":
        policy = embedded_policy(device=device)
    elif checkpoint == "dummy":
        policy = dummy_policy(device=device)
    else:
        path = Path(checkpoint).expanduser()
        detect_format(path)  # a folder that is no checkpoint is the first thing to say
        policy = load_pi_policy(path, _find_tokenizer(path, tokenizer), device=device)
    config = policy.model.config
    for option, given, actual in (
        ("--paligemma-variant", wanted["--paligemma-variant"], config.paligemma),
        ("--action-expert-variant", wanted["--action-expert-variant"], config.action_expert),
    ):
        if given is not None and given != actual:
            raise BadArgument(
                f"{option} contradicts the policy '{checkpoint}', whose part has {_sizes(actual)}, not {_sizes(given)}; "
                "leave the option out."
            )
    if num_image_tokens is not None and num_image_tokens != config.siglip.num_tokens:
        raise BadArgument(
            f"--num-image-tokens {num_image_tokens} contradicts the layout: each of the cameras {listing(config.cameras)} has "
            f"{config.siglip.num_tokens} keys; leave the option out."
        )
    return policy


def _sizes(config: GemmaConfig) -> str:
    name = next((name for name, variant in GEMMA_VARIANTS.items() if variant == config), "its own sizes")
    return f"width {config.width} and depth {config.depth} ({name})"


def _find_tokenizer(checkpoint: Path, tokenizer: str | None) -> Path:
    """The sentencepiece model: the one named, else the checkpoint's own, else openpi's cache."""
    if tokenizer is not None:
        return Path(tokenizer).expanduser()
    places = (
        checkpoint / "tokenizer" / "tokenizer.model",
        checkpoint / "paligemma_tokenizer.model",
        Path("~/.cache/openpi/big_vision/paligemma_tokenizer.model").expanduser(),
    )
    for place in places:
        if place.is_file():
            return place
    raise BadArgument(
        f"The checkpoint {checkpoint} needs PaliGemma's tokenizer and none was found at {listing(places)}; fetch "
        "paligemma_tokenizer.model (openpi downloads it from gs://big_vision) and give --tokenizer PATH."
    )
