"""Load a Cosmos policy from a published checkpoint, or build one from the options of the command line."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME, CosmosConfig, find_config
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, dit_tensors, infer_dit_config
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, EMBEDDED_CONFIG, random_policy
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
from vla_attention.capture.policies.cosmos.policy import ACTION_FRAME, CosmosPolicy
from vla_attention.capture.policies.cosmos.preprocess import read_statistics
from vla_attention.capture.policies.cosmos.sampler import noise_levels
from vla_attention.capture.policies.cosmos.t5_pickle import read_embeddings
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, PrecomputedText, T5Encoder
from vla_attention.capture.policies.cosmos.vae import build_encoder, infer_vae_config
from vla_attention.capture.policies.hub import downloads, hub_version
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.model_arguments import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.weights import find_dtype
from vla_attention.schemas.errors import BadArgument


@dataclass(frozen=True)
class CosmosOptions:
    """A user's choices for a policy; None takes the value of the checkpoint or of the named configuration.

    config_name: the reference's name for sizes, frames and noise levels. vae_path, statistics_path, embeddings_path,
    t5_tokenizer: files outside the checkpoint's folder. t5_encoder: folder of a T5 for instructions without a
    precomputed embedding. dtype: None takes bfloat16 on a GPU, like the reference, and float32 on a CPU. image_size:
    pixels of one side, for a checkpoint with another size than the published one.
    """

    config_name: str = DEFAULT_CONFIG_NAME
    num_denoising_steps: int | None = None
    chunk_size: int | None = None
    num_open_loop_steps: int | None = None
    statistics_path: str | None = None
    embeddings_path: str | None = None
    vae_path: str | None = None
    t5_tokenizer: str | None = None
    t5_encoder: str | None = None
    query_frame: str = ACTION_FRAME
    dtype: torch.dtype | None = None
    image_size: int | None = None

    def apply(self, config: CosmosConfig) -> CosmosConfig:
        """Return the configuration with the user's choices."""
        changes: dict[str, Any] = {}
        if self.num_denoising_steps is not None:
            changes["sampler"] = dataclasses.replace(config.sampler, num_steps=self.num_denoising_steps)
        if self.chunk_size is not None:
            changes["chunk_size"] = self.chunk_size
        if self.image_size is not None:
            changes["image_size"] = self.image_size
        return dataclasses.replace(config, **changes)

    def open_loop_steps(self, config: CosmosConfig) -> int:
        """Return how many actions of a chunk are executed; by default all of them."""
        return config.chunk_size if self.num_open_loop_steps is None else self.num_open_loop_steps


def load_cosmos_policy(
    checkpoint: str, *, options: CosmosOptions | None = None, device: str | torch.device = "cpu"
) -> CosmosPolicy:
    """Load a policy from a folder, a file of weights with the rest beside it, or a name on the Hugging Face hub.

    Sizes of the networks come from their tensors; frames, noise levels and picture size from the named configuration.
    """
    options = options or CosmosOptions()
    base = options.apply(find_config(options.config_name))  # wrong options are reported before any download
    base.frames.index(options.query_frame)
    place = find_checkpoint(checkpoint)
    # Small files first: if one is missing, the minutes for loading the weights are saved.
    weights_path = find_weights(place)
    statistics_path = find_beside(place, options.statistics_path, STATISTICS_NAME)
    statistics = read_statistics(statistics_path, base.action_dim, base.proprio_dim)
    embeddings_path = find_beside(place, options.embeddings_path, EMBEDDINGS_NAME)
    embeddings = read_embeddings(embeddings_path)
    encoder = T5Encoder(options.t5_encoder) if options.t5_encoder is not None else None
    # The folder of an encoder also has the tokenizer.
    tokenizer_path = find_t5_tokenizer(place, options.t5_tokenizer or options.t5_encoder)
    if tokenizer_path is None:
        print(
            "T5's tokenizer (spiece.model) was not found: the text's positions are recorded, but not the word of each; "
            "give --t5-tokenizer to select words.",
            file=sys.stderr,
            flush=True,
        )
    from_hub = not Path(checkpoint).expanduser().exists()
    vae_path = find_vae(place, options.vae_path, from_hub=from_hub)
    dtype = options.dtype or (torch.bfloat16 if torch.device(device).type == "cuda" else torch.float32)

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
    version = hub_version(place) if from_hub else None
    source = PolicySource(
        name="cosmos",
        # A name on the hub stands for other files tomorrow; with the commit it does not.
        checkpoint=str(version or checkpoint),
        checkpoint_format=weights_path.suffix.removeprefix("."),
        untrained=False,
        configuration=options.config_name,
        downloads=downloads(weights_path, vae_path, statistics_path, embeddings_path, tokenizer_path),
    )
    tokenizer = PieceTokenizer(tokenizer_path) if tokenizer_path is not None else None
    return CosmosPolicy(
        model,
        PrecomputedText(embeddings, tokenizer, encoder),
        statistics,
        source,
        open_loop_steps=options.open_loop_steps(config),
        query_frame=options.query_frame,
    )


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
