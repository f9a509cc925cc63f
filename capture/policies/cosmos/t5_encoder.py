"""T5's encoder from the transformers library, for instructions without a precomputed embedding."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vla_attention.capture.policies.cosmos.locate import T5_TOKENIZER
from vla_attention.capture.policies.hub import first_line
from vla_attention.schemas.errors import BadArgument, MissingDependency, UserError


class EncoderUnusable(UserError, ValueError):
    """The folder holds no T5 encoder, or one of another width."""


class T5Encoder:
    """T5's encoder (`google-t5/t5-11b` for the published policies) from a local folder, in float32.

    Loaded at the first use: it is many times as large as the policy, and most runs need precomputed embeddings only.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder).expanduser()
        if not (self.folder / "config.json").is_file():
            raise EncoderUnusable(
                f"There is no T5 encoder at '{self.folder}'; give --t5-encoder a folder with config.json, the weights "
                f"and {T5_TOKENIZER}."
            )
        self._model: Any = None

    def encode(self, ids: list[int], positions: int, width: int) -> Tensor:
        """Return the embedding (1, position, width) bfloat16 of token ids with the end token; other positions are 0."""
        if len(ids) > positions:
            raise BadArgument(
                f"The instruction has {len(ids)} tokens, but the policy reads {positions}; shorten the instruction."
            )
        model = self._load()
        if model.config.d_model != width:
            raise EncoderUnusable(
                f"The T5 encoder at '{self.folder}' gives {model.config.d_model} numbers a position, but the policy "
                f"reads {width}: it is another size of T5."
            )
        with torch.no_grad():
            hidden = model(input_ids=torch.tensor([ids])).last_hidden_state
        embedding = torch.zeros(1, positions, width, dtype=torch.bfloat16)
        embedding[:, : len(ids)] = hidden.to(torch.bfloat16)
        return embedding

    def _load(self) -> Any:
        if self._model is None:
            try:
                library = import_module("transformers")
            except ImportError as error:
                raise MissingDependency(
                    f"--t5-encoder needs the transformers library ({error}); install it with `pip install "
                    "transformers`, or precompute the embeddings elsewhere and give --t5-text-embeddings-path."
                ) from error
            try:
                self._model = library.T5EncoderModel.from_pretrained(
                    str(self.folder), local_files_only=True, dtype=torch.float32
                ).eval()
            except Exception as error:  # safetensors and pickle have errors of their own
                why = first_line(error)
                raise EncoderUnusable(f"The T5 encoder at '{self.folder}' cannot be loaded ({why}).") from error
        return self._model
