"""Build a Cosmos policy from the options of the command line."""

from __future__ import annotations

import torch

from vla_attention.capture.policies.cosmos.calls import select_call
from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME, find_config
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, EMBEDDED_CONFIG, random_policy
from vla_attention.capture.policies.cosmos.loading import CosmosOptions, load_cosmos_policy
from vla_attention.capture.policies.cosmos.policy import ACTION_FRAME, CosmosPolicy
from vla_attention.capture.policies.model_arguments import UNTRAINED, UNTRAINED_TINY, check_not_renamed
from vla_attention.capture.policies.precision import find_dtype
from vla_attention.schemas.errors import BadArgument

_UNTRAINED = {UNTRAINED: EMBEDDED_CONFIG, UNTRAINED_TINY: DUMMY_CONFIG}


def build_cosmos_policy(
    checkpoint: str,
    *,
    device: str,
    config_name: str = DEFAULT_CONFIG_NAME,
    num_denoising_steps_action: int | None = None,
    chunk_size: int | None = None,
    num_open_loop_steps: int | None = None,
    dataset_stats_path: str | None = None,
    t5_text_embeddings_path: str | None = None,
    t5_tokenizer: str | None = None,
    t5_encoder: str | None = None,
    vae_path: str | None = None,
    dtype: str | None = None,
    query_frame: str = ACTION_FRAME,
    visual_frame: str = "curr_last",
    text_frame: str = "frame0",
    prefer_s: int | None = None,
    prefer_call: str = "last",
) -> CosmosPolicy:
    """Build the policy and check the options against it; parameters are the options of the command line.

    `checkpoint` is a folder, a file of weights, a name on the hub, or one of the untrained policies that come with the
    package: `untrained`, `untrained-tiny`. Raises `BadArgument` or `UnknownName` for frames and calls that do not
    exist.
    """
    find_config(config_name)  # checked first, so that the error comes before any download
    options = CosmosOptions(
        config_name=config_name,
        num_denoising_steps=num_denoising_steps_action,
        chunk_size=chunk_size,
        num_open_loop_steps=num_open_loop_steps,
        statistics_path=dataset_stats_path,
        embeddings_path=t5_text_embeddings_path,
        vae_path=vae_path,
        t5_tokenizer=t5_tokenizer,
        t5_encoder=t5_encoder,
        query_frame=query_frame,
        dtype=find_dtype(dtype) if dtype is not None else None,
    )
    check_not_renamed(checkpoint)
    if checkpoint in _UNTRAINED:
        policy = _untrained(checkpoint, options, device)
    else:
        policy = load_cosmos_policy(checkpoint, options=options, device=device)
    for frame in (visual_frame, text_frame):
        policy.config.frames.index(frame)
    select_call(policy.config, prefer_s, prefer_call)
    return policy


def _untrained(name: str, options: CosmosOptions, device: str) -> CosmosPolicy:
    files = (
        options.statistics_path,
        options.embeddings_path,
        options.vae_path,
        options.t5_tokenizer,
        options.t5_encoder,
    )
    if any(files) or options.dtype == torch.bfloat16 or options.config_name != DEFAULT_CONFIG_NAME:
        raise BadArgument(
            f"The policy '{name}' comes with the program, in float32; --config-name, --dataset-stats-path, "
            "--t5-text-embeddings-path, --t5-tokenizer, --t5-encoder, --vae-path and --dtype bfloat16 are for "
            "checkpoints."
        )
    config = options.apply(_UNTRAINED[name])
    return random_policy(
        name,
        config,
        device=device,
        open_loop_steps=options.open_loop_steps(config),
        query_frame=options.query_frame,
    )
