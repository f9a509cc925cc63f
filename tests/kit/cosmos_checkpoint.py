"""Write a checkpoint folder with the files of the published repository, and random weights."""

from __future__ import annotations

import collections
import io
import json
import pickle
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from vla_attention.capture.policies.cosmos.config import CosmosConfig
from vla_attention.capture.policies.cosmos.dit_weights import COUNTER_PREFIX, EXTRA_STATE, PREFIX
from vla_attention.capture.policies.cosmos.embedded import BUILTIN_RANGES, random_dit_weights, random_vae_weights
from vla_attention.capture.policies.cosmos.locate import EMBEDDINGS_NAME, STATISTICS_NAME, VAE_NAME
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, SeededText
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.schemas.jsonable import to_json

WEIGHTS_NAME = "Cosmos-Policy-Dummy.pt"


def write_dummy_folder(
    folder: str | Path,
    config: CosmosConfig,
    instructions: Iterable[str],
    *,
    seed: int = 0,
    dtype: torch.dtype = torch.bfloat16,
    with_vae: bool = True,
    with_tokenizer: bool = False,
) -> Path:
    """Write weights, statistics, text embeddings of the instructions and the image encoder; returns the folder.

    The transformer's file has the published one's prefix, training counters and extra state. `with_vae` adds
    `tokenizer/tokenizer.pth`, which is published in another repository; `with_tokenizer` adds `spiece.model`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(published_state(config, seed, dtype), folder / WEIGHTS_NAME)
    statistics = {
        **to_json(BUILTIN_RANGES),
        **{
            f"{kind}_{name}": [0.0] * dim
            for kind, dim in (("actions", 7), ("proprio", 9))
            for name in ("mean", "std", "median")
        },
    }
    (folder / STATISTICS_NAME).write_text(json.dumps(statistics, indent=1))
    text = SeededText(PieceTokenizer(EMBEDDED_TOKENIZER), config.text_length, config.dit.text_dim, seed)
    embeddings = {instruction: text.encode(instruction).embedding for instruction in instructions}
    with open(folder / EMBEDDINGS_NAME, "wb") as file:
        pickle.dump(embeddings, file)
    if with_vae:
        vae = {name: tensor.to(dtype) for name, tensor in random_vae_weights(config.vae, seed).items()}
        (folder / VAE_NAME).parent.mkdir(exist_ok=True)
        torch.save(vae, folder / VAE_NAME)
    if with_tokenizer:
        shutil.copyfile(EMBEDDED_TOKENIZER, folder / "spiece.model")
    return folder


def published_state(config: CosmosConfig, seed: int, dtype: torch.dtype) -> dict[str, Any]:
    """Return the transformer's state with the published file's prefix, counters and extra state."""
    state: dict[str, Any] = collections.OrderedDict()
    for counter in ("video_sample_counter", "image_sample_counter", "iteration"):
        state[f"{PREFIX}{COUNTER_PREFIX}{counter}"] = torch.tensor(0)
    state[f"{PREFIX}{COUNTER_PREFIX}train_in_hours"] = torch.tensor(0.0)
    for name, tensor in random_dit_weights(config.dit, seed).items():
        state[PREFIX + name] = tensor.to(dtype)
        if name.endswith("norm.weight"):
            state[PREFIX + name.removesuffix("weight") + EXTRA_STATE] = io.BytesIO(b"")
    return state
