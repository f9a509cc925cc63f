"""An instruction for the policy: its embedding, the role of each text position, and its word pieces.

Without a precomputed embedding, T5's encoder of the transformers library makes one.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint
from vla_attention.capture.policies.cosmos.locate import T5_TOKENIZER
from vla_attention.capture.policies.cosmos.t5_pickle import TextEmbeddings
from vla_attention.schemas.errors import BadArgument, MissingDependency
from vla_attention.schemas.hub import first_line
from vla_attention.schemas.layout import ROLE_DTYPE, Piece, Prompt, Role


class T5Encoder:
    """T5's encoder (`google-t5/t5-11b` for the published policies) from a local folder, in float32.

    Loaded at the first use: it is many times as large as the policy, and most runs need precomputed embeddings only.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder).expanduser()
        if not (self.folder / "config.json").is_file():
            raise UnreadableCheckpoint(
                f"There is no T5 encoder at '{self.folder}'; give --t5-encoder a folder with config.json, the weights "
                f"and {T5_TOKENIZER}."
            )

    def encode(self, ids: list[int], positions: int, width: int) -> Tensor:
        """Return the embedding (1, position, width) bfloat16 of token ids with the end token; other positions are 0."""
        if len(ids) > positions:
            raise BadArgument(
                f"The instruction has {len(ids)} tokens, but the policy reads {positions}; shorten the instruction."
            )
        model = self._model
        if model.config.d_model != width:
            raise UnreadableCheckpoint(
                f"The T5 encoder at '{self.folder}' gives {model.config.d_model} numbers a position, but the policy "
                f"reads {width}: it is another size of T5."
            )
        with torch.no_grad():
            hidden = model(input_ids=torch.tensor([ids])).last_hidden_state
        embedding = torch.zeros(1, positions, width, dtype=torch.bfloat16)
        embedding[:, : len(ids)] = hidden.to(torch.bfloat16)
        return embedding

    @cached_property
    def _model(self) -> Any:
        try:
            library = import_module("transformers")
        except ImportError as error:
            raise MissingDependency(
                f"--t5-encoder needs the transformers library ({error}); install it with `pip install transformers`, "
                "or precompute the embeddings elsewhere and give --t5-text-embeddings-path."
            ) from error
        try:
            model = library.T5EncoderModel.from_pretrained(str(self.folder), local_files_only=True, dtype=torch.float32)
        except Exception as error:  # safetensors and pickle have errors of their own
            why = first_line(error)
            raise UnreadableCheckpoint(f"The T5 encoder at '{self.folder}' cannot be loaded ({why}).") from error
        return model.eval()


#: T5 ends every text with this token, which has a position and no characters.
END_TOKENS = 1


@dataclass(frozen=True)
class EncodedText:
    """An instruction for the model: embedding (1, position, width), roles (position,) uint8, prompt with pieces."""

    embedding: Tensor
    roles: NDArray[np.uint8]
    prompt: Prompt


class TextSource(Protocol):
    """Turns instructions into embeddings."""

    def encode(self, instruction: str) -> EncodedText:
        """Return the embedding of an instruction, and the role of each position."""

    def provenance(self) -> dict[str, Any]:
        """Return plain JSON values that identify the source."""


class PieceTokenizer:
    """T5's sentencepiece model: a text's pieces and the characters of each."""

    def __init__(self, path: str | Path):
        # Here: T5's encoder is also tried where transformers is, and sentencepiece is not.
        from vla_attention.capture.policies.sentencepiece_model import SentencepieceModel

        self.model = SentencepieceModel(path, "give T5's spiece.model")
        self.path = self.model.path
        #: SHA-256 (hex) of the file
        self.digest = self.model.digest

    def token_ids(self, text: str) -> list[int]:
        """Return the ids of a text's pieces, and T5's end token."""
        return [*(token.id for token in self.model.encode(text)), self.model.eos_id]

    def pieces(self, text: str) -> tuple[Piece, ...]:
        """Return the pieces of a text, keys counted from 0, without the end token."""
        tokens = self.model.encode(text)
        return tuple(Piece(key, token.piece, token.start, token.stop) for key, token in enumerate(tokens))


def text_roles(is_real: NDArray[np.bool_], num_pieces: int | None) -> NDArray[np.uint8]:
    """Return the role code of each position, (position,) uint8. Padded positions are `null`: they contribute exactly 0.

    If the pieces are known, their positions are `instruction`, and the position after them (T5's end token) is
    `template`. Else every real position is `text`.
    """
    roles = np.full(len(is_real), Role.NULL, dtype=ROLE_DTYPE)
    if num_pieces is None:
        roles[is_real] = Role.TEXT
        return roles
    roles[is_real] = Role.TEMPLATE
    roles[:num_pieces] = Role.INSTRUCTION
    return roles


class PrecomputedText:
    """Embeddings from a file. T5's tokenizer is optional; without it no position is known as a word.

    With an encoder and the tokenizer, instructions that the file lacks are encoded. An empty instruction that the file
    lacks is an embedding of zeros.
    """

    def __init__(
        self, embeddings: TextEmbeddings, tokenizer: PieceTokenizer | None = None, encoder: T5Encoder | None = None
    ):
        if encoder is not None and tokenizer is None:
            raise UnreadableCheckpoint("--t5-encoder needs T5's tokenizer; give --t5-tokenizer PATH (spiece.model).")
        self.embeddings = embeddings
        self.tokenizer = tokenizer
        self.encoder = encoder
        self._encoded: dict[str, Tensor] = {}

    def _embedding(self, instruction: str) -> Tensor:
        in_file = not instruction or instruction in self.embeddings.by_instruction
        if in_file or self.encoder is None or self.tokenizer is None:
            return self.embeddings.find(instruction)
        if instruction not in self._encoded:
            ids = self.tokenizer.token_ids(instruction)
            self._encoded[instruction] = self.encoder.encode(ids, *self.embeddings.shape)
        return self._encoded[instruction]

    def encode(self, instruction: str) -> EncodedText:
        """Return the embedding and its roles; `UnknownName` or `UnreadableCheckpoint` if either does not fit."""
        embedding = self._embedding(instruction)
        is_real = embedding[0].ne(0).any(dim=-1).numpy()
        count = int(is_real.sum())
        if not is_real[:count].all():
            raise UnreadableCheckpoint(
                f"The text embedding of '{instruction}' in '{self.embeddings.path}' has zero positions between real "
                "ones; expected the real tokens first and zeros after them."
            )
        whole = (0, len(instruction))
        if self.tokenizer is None:
            return EncodedText(embedding, text_roles(is_real, None), Prompt(instruction, (), whole))
        pieces = self.tokenizer.pieces(instruction)
        # An embedding of zeros only is a text that was left out on purpose.
        if count and count != len(pieces) + END_TOKENS:
            raise UnreadableCheckpoint(
                f"The tokenizer '{self.tokenizer.path}' cuts '{instruction}' into {len(pieces)} pieces and an end "
                f"token, but its embedding has {count} real positions: it is another model's tokenizer."
            )
        known = pieces if count else ()
        return EncodedText(embedding, text_roles(is_real, len(known)), Prompt(instruction, known, whole))

    def provenance(self) -> dict[str, Any]:
        """Return the digests of the embeddings and of the tokenizer."""
        return {
            "prompt_format": "t5-embedding",
            "text_embeddings_digest": self.embeddings.digest,
            "tokenizer_digest": self.tokenizer.digest if self.tokenizer is not None else None,
            "text_encoder": str(self.encoder.folder) if self.encoder is not None else None,
        }


class SeededText:
    """Made-up embeddings for untrained policies: every piece has a random vector, the same in all instructions."""

    def __init__(self, tokenizer: PieceTokenizer, positions: int, width: int, seed: int):
        self.tokenizer = tokenizer
        self.positions, self.width, self.seed = positions, width, seed

    def encode(self, instruction: str) -> EncodedText:
        """Return the embedding of any instruction that fits into the positions."""
        pieces = self.tokenizer.pieces(instruction)
        count = len(pieces) + END_TOKENS
        if count > self.positions:
            raise BadArgument(
                f"The instruction '{instruction}' has {count} tokens, but the policy has room for {self.positions}."
            )
        embedding = np.zeros((1, self.positions, self.width), dtype=np.float32)
        for key, name in enumerate([*(piece.text for piece in pieces), "</s>"]):
            words = [self.seed, zlib.crc32(name.encode()), zlib.crc32(b"text")]
            embedding[0, key] = np.random.Generator(np.random.Philox(np.random.SeedSequence(words))).standard_normal(
                self.width, dtype=np.float32
            )
        is_real = np.arange(self.positions) < count
        prompt = Prompt(instruction, pieces, (0, len(instruction)))
        # bfloat16, as the published embeddings are
        return EncodedText(torch.from_numpy(embedding).bfloat16(), text_roles(is_real, len(pieces)), prompt)

    def provenance(self) -> dict[str, Any]:
        """Return the seed and the tokenizer's digest."""
        return {
            "prompt_format": "made-up embeddings",
            "text_embeddings_digest": f"seed {self.seed}",
            "tokenizer_digest": self.tokenizer.digest,
        }
