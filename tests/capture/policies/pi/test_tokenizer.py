"""Prompts: the strings that openpi encodes, and the roles of tokens, also for confusing instructions."""

import itertools
import json

import numpy as np
import pytest

from tests.kit.pi_golden import GOLDEN
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer, clean_instruction
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import Role

STATE = np.array([0.1, -0.2, 1.5, -1.5, 0.0, 0.99, -1.0, 1.0])
STATE_TEXT = "140 102 255 -1 128 254 0 255"
AWKWARD = [
    "put the black bowl on the plate",
    "turn on the stove.",
    "pick up the book, and place it -- gently -- in the caddy!",
    "put  both   moka pots on the stove",
    "  pick_up_the_black_bowl\non the stove ",
    "_lift_",
    "State: 12 24; Action: push the State button, State: 3",
    "Task: Task: , State: ",
    "sláinte: 把碗放在盘子上 🤖 naïve café",
    "put the bowl\ton\u00a0the plate",
    "7 bowls, 42 plates",
]


@pytest.fixture(scope="module")
def tokenizer():
    return PromptTokenizer(EMBEDDED_TOKENIZER)


@pytest.fixture(scope="module")
def processor(tokenizer):
    return tokenizer.model._processor


@pytest.mark.parametrize("entry", json.loads((GOLDEN / "libero_preproc" / "prompts.json").read_text()))
def test_encodes_the_strings_that_openpi_encodes(tokenizer, processor, entry):
    without = tokenizer.tokenize(entry["prompt"], max_token_len=200)
    calls = entry["no_state_encode_calls"]
    ids = [id_ for text, bos in calls for id_ in processor.encode(text, add_bos=bos)]
    assert without.ids[without.mask].tolist() == ids
    assert without.prompt.text == "".join(text for text, _ in calls)

    [(text, _)] = entry["with_state_encode_calls"]
    digits = [int(number) for number in text.split("State: ")[1].split(";")[0].split()]
    state = np.array([(number + 0.5) / 128 - 1 for number in digits])
    with_state = tokenizer.tokenize(entry["prompt"], max_token_len=200, state=state)
    assert with_state.prompt.text == text
    assert with_state.ids[with_state.mask].tolist() == processor.encode(text, add_bos=True)


@pytest.mark.parametrize("instruction", AWKWARD)
@pytest.mark.parametrize("state", [None, STATE], ids=["plain", "with-state"])
def test_pieces_cover_the_text_and_roles_follow_the_characters(tokenizer, instruction, state):
    got = tokenizer.tokenize(instruction, max_token_len=200, first_key=768, state=state)
    text, pieces = got.prompt.text, got.prompt.pieces
    cleaned = clean_instruction(instruction)
    assert got.prompt.instruction_text == cleaned
    assert text == (f"{cleaned}\n" if state is None else f"Task: {cleaned}, State: {STATE_TEXT};\nAction: ")

    # slots: BOS, one per piece, padding; the pieces' keys are those slots
    assert got.roles[0] == Role.BOS
    assert [piece.key - 768 for piece in pieces] == list(range(1, 1 + len(pieces)))
    assert got.mask.sum() == 1 + len(pieces)
    assert (got.roles[~got.mask] == Role.PADDING).all()
    assert (got.ids[~got.mask] == 0).all()
    assert (got.roles.dtype, got.roles.shape, got.ids.dtype) == (np.uint8, (200,), np.int64)

    # pieces are in order, never empty, and leave no character out
    covered = set()
    for before, after in itertools.pairwise(pieces):
        assert before.start <= after.start
    for piece in pieces:
        assert piece.start < piece.stop
        covered.update(range(piece.start, piece.stop))
        if not piece.text.startswith("<0x"):
            assert piece.text.replace("▁", " ") == text[piece.start : piece.stop]
    assert covered == set(range(len(text)))

    # by role, the visible characters are exactly those of the parts
    def visible(role):
        keys = [p for p in pieces if got.roles[p.key - 768] == role]
        characters = {i for p in keys for i in range(p.start, p.stop)}
        return "".join(text[i] for i in sorted(characters) if not text[i].isspace())

    squeezed = "".join(cleaned.split())
    assert visible(Role.INSTRUCTION) == squeezed
    assert visible(Role.STATE) == ("" if state is None else "".join(STATE_TEXT.split()))
    assert visible(Role.TEMPLATE) == ("" if state is None else "Task:,State:;Action:")


@pytest.mark.parametrize("instruction", AWKWARD)
@pytest.mark.parametrize("prompt_format", ["raw-instruction-newline", "raw-instruction"])
def test_raw_prompts_leave_the_instruction_alone(tokenizer, processor, instruction, prompt_format):
    got = tokenizer.tokenize(instruction, max_token_len=200, prompt_format=prompt_format)
    body = instruction.removesuffix("\n") if prompt_format == "raw-instruction-newline" else instruction
    text = body + "\n" * (prompt_format == "raw-instruction-newline")
    assert got.prompt.text == text
    assert got.prompt.instruction_text == body
    assert got.ids[got.mask].tolist() == processor.encode(text, add_bos=True)
    roles = {text[p.start : p.stop]: got.roles[p.key] for p in got.prompt.pieces}
    assert all(
        (role == Role.TEMPLATE) == (piece == "\n" and text.endswith("\n"))
        for piece, role in roles.items()
        if piece != "\n"
    )
    assert (got.roles[got.mask] == Role.STATE).sum() == 0


@pytest.mark.parametrize("instruction", AWKWARD)
@pytest.mark.parametrize("state", [None, STATE], ids=["plain", "with-state"])
@pytest.mark.parametrize("room", [1, 2, 5, 30])
def test_a_cut_prompt_is_the_beginning_of_the_whole_one(tokenizer, instruction, state, room):
    whole = tokenizer.tokenize(instruction, max_token_len=200, state=state)
    cut = tokenizer.tokenize(instruction, max_token_len=room, state=state, cut=True)
    length = int(whole.mask.sum())
    assert cut.num_cut == max(0, length - room)
    kept = min(room, length)
    np.testing.assert_array_equal(cut.ids[:kept], whole.ids[:kept])
    np.testing.assert_array_equal(cut.roles[:kept], whole.roles[:kept])
    assert cut.mask.sum() == kept
    assert cut.prompt.pieces == whole.prompt.pieces[: kept - 1]
    assert cut.prompt.text == whole.prompt.text


def test_a_newline_is_a_template_token_of_its_own(tokenizer):
    got = tokenizer.tokenize("open the door", max_token_len=20)
    assert got.prompt.pieces[-1].text == "\n"
    assert got.roles[got.mask][-1] == Role.TEMPLATE


def test_bytes_of_one_character_share_its_range(tokenizer):
    got = tokenizer.tokenize("碗", max_token_len=20)
    spans = [(p.text, p.start, p.stop) for p in got.prompt.pieces[:-1]]
    assert spans == [("<0xE7>", 0, 1), ("<0xA2>", 0, 1), ("<0x97>", 0, 1)]


def test_a_prompt_that_does_not_fit_is_refused_not_cut(tokenizer):
    fits = int(tokenizer.tokenize("open the door", max_token_len=48).mask.sum())
    assert tokenizer.tokenize("open the door", max_token_len=fits).mask.all()
    with pytest.raises(BadArgument, match=rf"'open the door' .* {fits} .* {fits - 1}"):
        tokenizer.tokenize("open the door", max_token_len=fits - 1)
