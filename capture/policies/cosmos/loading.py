"""Load a Cosmos policy from a published checkpoint, or build one from the options of the command line."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from vla_attention.capture.policies.cosmos.config import CosmosConfig, find_config
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
from vla_attention.capture.policies.cosmos.preprocess import Ranges, read_ranges
from vla_attention.capture.policies.cosmos.sampler import noise_levels
from vla_attention.capture.policies.cosmos.t5_pickle import TextEmbeddings, read_embeddings
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, PrecomputedText, T5Encoder
from vla_attention.capture.policies.cosmos.vae import build_encoder, infer_vae_config
from vla_attention.capture.policies.family import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.weights import DTYPES
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.hub import downloads, lasting_name, would_be_fetched


@dataclass(frozen=True)
class _Planned:
    """A policy of a checkpoint but for its weights; config: without the sizes that only they tell."""

    config: CosmosConfig
    weights: Path
    vae: Path
    ranges: Ranges
    embeddings: TextEmbeddings
    encoder: T5Encoder | None
    tokenizer: PieceTokenizer | None
    source: PolicySource


def _plan(settings: CosmosSettings) -> _Planned:
    """Find the files of a checkpoint and read the small ones, before the minutes for loading its weights."""
    checkpoint = settings.checkpoint
    config = settings.apply(find_config(settings.config_name))  # wrong options are reported before any download
    config.frames.index(settings.query_frame)
    place = find_checkpoint(checkpoint)
    weights = find_weights(place)
    statistics = find_beside(place, settings.dataset_stats_path, STATISTICS_NAME)
    ranges = read_ranges(statistics, config.action_dim, config.proprio_dim)
    embeddings = read_embeddings(find_beside(place, settings.t5_text_embeddings_path, EMBEDDINGS_NAME))
    encoder = T5Encoder(settings.t5_encoder) if settings.t5_encoder is not None else None
    for instruction in settings.instructions if encoder is None else ():
        embeddings.find(instruction)
    # The folder of an encoder also has the tokenizer.
    tokenizer = find_t5_tokenizer(place, settings.t5_tokenizer or settings.t5_encoder)
    vae = find_vae(place, settings.vae_path, from_hub=not Path(checkpoint).expanduser().exists())
    source = PolicySource(
        name="cosmos",
        checkpoint=lasting_name(checkpoint, place),
        checkpoint_format=weights.suffix.removeprefix("."),
        untrained=False,
        configuration=settings.config_name,
        downloads=downloads(weights, vae, statistics, Path(embeddings.path), tokenizer),
    )
    pieces = PieceTokenizer(tokenizer) if tokenizer is not None else None
    return _Planned(config, weights, vae, ranges, embeddings, encoder, pieces, source)


def load_cosmos_policy(settings: CosmosSettings, device: str | torch.device = "cpu") -> CosmosPolicy:
    """Load a policy from a folder, a file of weights with the rest beside it, or a name on the Hugging Face hub.

    Sizes of the networks come from their tensors; frames, noise levels and picture size from the named configuration.
    """
    planned = _plan(settings)
    if planned.tokenizer is None:
        print(
            "T5's tokenizer (spiece.model) was not found: the text's positions are recorded, but not the word of each; "
            "give --t5-tokenizer to select words.",
            file=sys.stderr,
            flush=True,
        )
    dtype = DTYPES[settings.dtype or ("bfloat16" if torch.device(device).type == "cuda" else "float32")]
    weights, vae_state = dit_tensors(read_tensors(planned.weights)), read_tensors(planned.vae)
    positions, width = planned.embeddings.shape
    config = dataclasses.replace(
        planned.config,
        dit=infer_dit_config(weights, planned.config.dit),
        vae=infer_vae_config(vae_state, planned.config.vae),
        text_length=positions,
    )
    if width != config.dit.text_dim:
        raise BadArgument(
            f"The text embeddings of '{planned.embeddings.path}' have {width} numbers a position, but the policy reads "
            f"{config.dit.text_dim}: they belong to another model."
        )
    return CosmosPolicy(
        CosmosModel(
            config,
            build_dit(config.dit, weights, dtype=dtype, device=device),
            build_encoder(config.vae, vae_state, dtype=dtype, device=device),
        ),
        PrecomputedText(planned.embeddings, planned.tokenizer, planned.encoder),
        planned.ranges,
        planned.source,
        open_loop_steps=settings.open_loop_steps(config),
        query_frame=settings.query_frame,
    )


def check_cosmos_files(settings: CosmosSettings) -> None:
    """Raise what `build_cosmos_policy` would where a checkpoint of this machine lacks files; reads no weights."""
    if settings.checkpoint not in _UNTRAINED and not would_be_fetched(settings.checkpoint):
        planned = _plan(settings)
        for file in (planned.weights, planned.vae):
            read_tensors(file)  # mapped into memory: the numbers are not read


def check_call_length(config: CosmosConfig, length: int | None) -> None:
    """Raise `BadArgument` unless the policy's calls have the sequence length of `--prefer-S`; None takes any."""
    found = config.frames.count * config.tokens_per_frame
    if length not in (None, found):
        raise BadArgument(
            f"No call has --prefer-S {length}: all {len(noise_levels(config.sampler))} calls of this policy have S = "
            f"{found} ({config.frames.count} latent frames of {config.tokens_per_frame} tokens)."
        )


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
    check_call_length(policy.config, settings.prefer_s)
    return policy


def _untrained(settings: CosmosSettings, device: str) -> CosmosPolicy:
    settings.refuse_for_untrained(
        "config_name", "dataset_stats_path", "t5_text_embeddings_path", "t5_tokenizer", "t5_encoder", "vae_path"
    )
    name = settings.checkpoint
    config = settings.apply(_UNTRAINED[name])
    return random_policy(
        name,
        config,
        device=device,
        open_loop_steps=settings.open_loop_steps(config),
        query_frame=settings.query_frame,
    )
