from __future__ import annotations

import numpy as np

from examples.cubes_policy.batches import number_ids
from examples.cubes_policy.vocabulary import NUMBERS, WORDS, make_tokenizer
from vla_attention.schemas.layout import Role


def test_the_model_file_is_the_same_every_time():
    assert make_tokenizer() == make_tokenizer()


def test_listed_words_numbers_and_the_template_are_one_token_each(tokenizer):
    prompt = tokenizer.tokenize(
        "put the red cube on the green cube", max_token_len=32, state=np.array([-2.0, 0, 0.5, 2, -1, 1, 0.1, -0.1])
    )
    assert [piece.text for piece in prompt.prompt.pieces] == [
        *("Task:", "▁put", "▁the", "▁red", "▁cube", "▁on", "▁the", "▁green", "▁cube", ",", "▁State:"),
        *("▁-1", "▁128", "▁192", "▁255", "▁0", "▁255", "▁140", "▁115", ";", "\n", "Action:", "▁"),
    ]
    assert int((prompt.roles == Role.STATE).sum()) == 8
    assert int((prompt.roles == Role.INSTRUCTION).sum()) == 8
    words = [prompt.prompt.text[piece.start : piece.stop].strip() for piece in prompt.prompt.pieces[1:9]]
    assert " ".join(words) == "put the red cube on the green cube"


def test_every_word_and_number_has_its_own_token(tokenizer):
    tokens = tokenizer.model.encode("".join(f" {word}" for word in WORDS))
    assert [token.piece for token in tokens] == [f"▁{word}" for word in WORDS]
    assert len(set(number_ids(tokenizer))) == len(NUMBERS) == 257
