"""sentencepiece models: the pieces of a text, with their ids and characters."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import sentencepiece

from vla_attention.capture.policies.checkpoints import CheckpointNotFound, UnreadableCheckpoint
from vla_attention.schemas.checked_files import check_regular

#: Bytes of a model. PaliGemma's, of 257,152 pieces, has 4.3 MB.
MAX_MODEL_BYTES = 64_000_000
#: The small model of the untrained policies that come with this package.
EMBEDDED_TOKENIZER = Path(__file__).parent / "embedded" / "tokenizer.model"


@dataclass(frozen=True)
class Token:
    """One encoded token: id, vocabulary piece, and its characters [start, stop) of the text."""

    id: int
    piece: str
    start: int
    stop: int


class SentencepieceModel:
    """A sentencepiece model from a file. `needed`: ends the error message if there is no file."""

    def __init__(self, path: str | Path, needed: str):
        path = Path(path)
        try:
            size = check_regular(path, UnreadableCheckpoint)
        except FileNotFoundError:
            raise CheckpointNotFound(f"There is no tokenizer file at '{path}'; {needed}.") from None
        if size > MAX_MODEL_BYTES:
            raise UnreadableCheckpoint(
                f"'{path}' has {size} bytes; a sentencepiece model of {MAX_MODEL_BYTES} at most is read."
            )
        content = path.read_bytes()
        self.path = str(path)
        #: SHA-256 (hex) of the file
        self.digest = hashlib.sha256(content).hexdigest()
        self._processor = sentencepiece.SentencePieceProcessor()
        try:
            self._processor.LoadFromSerializedProto(content)
        except (RuntimeError, OSError) as error:
            raise UnreadableCheckpoint(f"'{path}' is not a sentencepiece model, or it is damaged.") from error
        #: Number of ids, and those of the tokens that begin and end a text; negative if there is none.
        self.vocab_size = int(self._processor.get_piece_size())
        self.bos_id, self.eos_id = int(self._processor.bos_id()), int(self._processor.eos_id())

    def encode(self, text: str) -> list[Token]:
        """Encode a text, without tokens for its begin and end; offsets count characters."""
        # sentencepiece 0.2.3 replaced its proto objects; the new ones need the protobuf package.
        if hasattr(self._processor, "EncodeAsOffsetMapping"):
            encoded = self._processor.EncodeAsOffsetMapping(text)
            parts = zip(encoded["ids"], encoded["pieces"], encoded["offsets"], strict=True)
            return [Token(int(id_), piece, start, stop) for id_, piece, (start, stop) in parts]
        encode = getattr(self._processor, "EncodeAsImmutableProto")  # noqa: B009 - newer type stubs lack it
        return [Token(p.id, p.piece, p.begin, p.end) for p in encode(text).pieces]
