"""Load a Cosmos policy from a published checkpoint: weights, statistics, text embeddings and image encoder."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME, CosmosConfig, find_config
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, dit_tensors, infer_dit_config
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
from vla_attention.capture.policies.cosmos.t5_encoder import T5Encoder
from vla_attention.capture.policies.cosmos.t5_pickle import read_embeddings
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, PrecomputedText
from vla_attention.capture.policies.cosmos.vae import build_encoder, infer_vae_config
from vla_attention.capture.policies.hub import downloads, hub_version
from vla_attention.capture.policies.identity import PolicySource
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
