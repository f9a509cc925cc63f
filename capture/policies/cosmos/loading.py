"""Load a Cosmos policy from a published checkpoint, or build one from the options of the command line."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import torch

from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME, CosmosConfig, find_config
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, dit_tensors, infer_dit_config
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, EMBEDDED_CONFIG, random_policy
from vla_attention.capture.policies.cosmos.family import CosmosSettings
from vla_attention.capture.policies.cosmos.locate import (
    EMBEDDINGS_NAME,
    STATISTICS_NAME,
    find_beside,
    find_checkpoint,
    find_t5_tokenizer,
    find_vae,
    find_weights,
)
from vla_attention.capture.policies.cosmos.model import CosmosModel
from vla_attention.capture.policies.cosmos.policy import CosmosPolicy
from vla_attention.capture.policies.cosmos.preprocess import read_ranges
from vla_attention.capture.policies.cosmos.sampler import noise_levels
from vla_attention.capture.policies.cosmos.t5_pickle import read_embeddings
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, PrecomputedText, T5Encoder
from vla_attention.capture.policies.cosmos.vae import build_encoder, infer_vae_config
from vla_attention.capture.policies.family import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.hub import downloads, lasting_name
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.weights import DTYPES
from vla_attention.schemas.errors import BadArgument


def load_cosmos_policy(settings: CosmosSettings, device: str | torch.device = "cpu") -> CosmosPolicy:
    """Load a policy from a folder, a file of weights with the rest beside it, or a name on the Hugging Face hub.

    Sizes of the networks come from their tensors; frames, noise levels and picture size from the named configuration.
    """
    checkpoint = settings.checkpoint
    base = settings.apply(find_config(settings.config_name))  # wrong options are reported before any download
    base.frames.index(settings.query_frame)
    place = find_checkpoint(checkpoint)
    # Small files first: if one is missing, the minutes for loading the weights are saved.
    weights_path = find_weights(place)
    statistics_path = find_beside(place, settings.dataset_stats_path, STATISTICS_NAME)
    statistics = read_ranges(statistics_path, base.action_dim, base.proprio_dim)
    embeddings_path = find_beside(place, settings.t5_text_embeddings_path, EMBEDDINGS_NAME)
    embeddings = read_embeddings(embeddings_path)
    encoder = T5Encoder(settings.t5_encoder) if settings.t5_encoder is not None else None
    for instruction in settings.instructions if encoder is None else ():
        embeddings.find(instruction)
    # The folder of an encoder also has the tokenizer.
    tokenizer_path = find_t5_tokenizer(place, settings.t5_tokenizer or settings.t5_encoder)
    if tokenizer_path is None:
        print(
            "T5's tokenizer (spiece.model) was not found: the text's positions are recorded, but not the word of each; "
            "give --t5-tokenizer to select words.",
            file=sys.stderr,
            flush=True,
        )
    from_hub = not Path(checkpoint).expanduser().exists()
    vae_path = find_vae(place, settings.vae_path, from_hub=from_hub)
    dtype = DTYPES[settings.dtype or ("bfloat16" if torch.device(device).type == "cuda" else "float32")]

    weights = dit_tensors(read_tensors(weights_path))
    vae_state = read_tensors(vae_path)
    positions, width = embeddings.shape
    config = dataclasses.replace(
        base,
        dit=infer_dit_config(weights, base.dit),
        vae=infer_vae_config(vae_state, base.vae),
        text_length=positions,
    )
    if width != config.dit.text_dim:
        raise BadArgument(
            f"The text embeddings of '{embeddings.path}' have {width} numbers a position, but the policy reads "
            f"{config.dit.text_dim}: they belong to another model."
        )
    model = CosmosModel(
        config,
        build_dit(config.dit, weights, dtype=dtype, device=device),
        build_encoder(config.vae, vae_state, dtype=dtype, device=device),
    )
    source = PolicySource(
        name="cosmos",
        checkpoint=lasting_name(checkpoint, place),
        checkpoint_format=weights_path.suffix.removeprefix("."),
        untrained=False,
        configuration=settings.config_name,
        downloads=downloads(weights_path, vae_path, statistics_path, embeddings_path, tokenizer_path),
    )
    tokenizer = PieceTokenizer(tokenizer_path) if tokenizer_path is not None else None
    return CosmosPolicy(
        model,
        PrecomputedText(embeddings, tokenizer, encoder),
        statistics,
        source,
        open_loop_steps=settings.open_loop_steps(config),
        query_frame=settings.query_frame,
    )


def select_call(config: CosmosConfig, prefer_s: int | None, prefer_call: Literal["last", "first"]) -> int:
    """Return the denoise step that `--prefer-S` and `--prefer-call` choose.

    prefer_s: sequence length that the call must have; None takes any. prefer_call: `last` or `first` of those.
    Raises `BadArgument` when no call has that length.
    """
    count = len(noise_levels(config.sampler))
    length = config.frames.count * config.tokens_per_frame
    if prefer_s is not None and prefer_s != length:
        raise BadArgument(
            f"No call has --prefer-S {prefer_s}: all {count} calls of this policy have S = {length} "
            f"({config.frames.count} latent frames of {config.tokens_per_frame} tokens)."
        )
    return 0 if prefer_call == "first" else count - 1


_UNTRAINED = {UNTRAINED: EMBEDDED_CONFIG, UNTRAINED_TINY: DUMMY_CONFIG}


def build_cosmos_policy(settings: CosmosSettings, device: str) -> CosmosPolicy:
    """Build the policy and check the settings against it.

    Raises `BadArgument` or `UnknownName` for frames and calls that do not exist.
    """
    find_config(settings.config_name)  # checked first, so that the error comes before any download
    untrained = settings.checkpoint in _UNTRAINED
    policy = _untrained(settings, device) if untrained else load_cosmos_policy(settings, device)
    for frame in (settings.visual_frame, settings.text_frame):
        policy.config.frames.index(frame)
    select_call(policy.config, settings.prefer_s, settings.prefer_call)
    return policy


def _untrained(settings: CosmosSettings, device: str) -> CosmosPolicy:
    name = settings.checkpoint
    files = (
        settings.dataset_stats_path,
        settings.t5_text_embeddings_path,
        settings.vae_path,
        settings.t5_tokenizer,
        settings.t5_encoder,
    )
    if any(files) or settings.dtype == "bfloat16" or settings.config_name != DEFAULT_CONFIG_NAME:
        raise BadArgument(
            f"The policy '{name}' comes with the program, in float32; --config-name, --dataset-stats-path, "
            "--t5-text-embeddings-path, --t5-tokenizer, --t5-encoder, --vae-path and --dtype bfloat16 are for "
            "checkpoints."
        )
    config = settings.apply(_UNTRAINED[name])
    return random_policy(
        name,
        config,
        device=device,
        open_loop_steps=settings.open_loop_steps(config),
        query_frame=settings.query_frame,
    )
