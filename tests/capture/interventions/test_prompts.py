"""Other instructions: empty, shuffled, another task's, any text, synonyms."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.capture.interventions.prompts import (
    changed_instruction,
    check_synonyms,
    read_synonyms,
    shuffled,
    with_synonyms,
)
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import PromptChange

INSTRUCTION = "put the black_bowl on the plate"
INSTRUCTIONS = {0: INSTRUCTION, 3: "open the drawer"}


def changed(change: PromptChange, task_id: int = 0, episode_index: int = 0) -> str:
    return changed_instruction(
        INSTRUCTION, change, task_id=task_id, episode_index=episode_index, instructions=INSTRUCTIONS
    )


def test_empty_text_and_another_tasks():
    assert changed(PromptChange("empty")) == ""
    assert changed(PromptChange("text", text="close it")) == "close it"
    assert changed(PromptChange("task", task_id=3)) == "open the drawer"
    with pytest.raises(BadArgument, match=r"task 4; .* 0, 3 "):
        changed(PromptChange("task", task_id=4))


def test_shuffled_words_are_the_same_words_in_another_order_of_the_episode():
    orders = {changed(PromptChange("shuffled"), episode_index=index) for index in range(20)}
    assert len(orders) > 5
    assert INSTRUCTION not in orders
    for order in orders:
        assert sorted(order.split()) == sorted(INSTRUCTION.split())
    assert changed(PromptChange("shuffled"), 0, 1) == changed(PromptChange("shuffled"), 0, 1)
    assert changed(PromptChange("shuffled", seed=1), 0, 1) != changed(PromptChange("shuffled"), 0, 1)


@pytest.mark.parametrize("text", ["lift", "go go go", ""])
def test_words_without_another_order_stay(text):
    assert shuffled(text, np.random.default_rng(0)) == text


def test_two_words_change_places():
    assert shuffled("open it", np.random.default_rng(0)) == "it open"


def test_synonyms_replace_whole_words_and_nothing_else():
    text = "Put the bowl, the bowls and the BOWL's lid on the\tplate"
    assert with_synonyms(text, {"bowl": "dish", "put": "set"}) == (
        "set the dish, the bowls and the BOWL's lid on the\tplate"
    )
    assert changed(PromptChange("synonyms", synonyms={"Bowl": "dish"})) == "put the black_dish on the plate"
    check_synonyms(PromptChange("synonyms", synonyms={"DRAWER": "box"}), INSTRUCTIONS.values())
    with pytest.raises(BadArgument, match="'cup'"):
        check_synonyms(PromptChange("synonyms", synonyms={"cup": "mug"}), INSTRUCTIONS.values())


def test_files_of_synonyms(tmp_path):
    (tmp_path / "a.json").write_text('{"bowl": "dish", "plate": "flat dish"}')
    (tmp_path / "a.toml").write_text('bowl = "dish"\nplate = "flat dish"\n')
    expected = {"bowl": "dish", "plate": "flat dish"}
    assert read_synonyms(tmp_path / "a.json") == expected
    assert read_synonyms(tmp_path / "a.toml") == expected
