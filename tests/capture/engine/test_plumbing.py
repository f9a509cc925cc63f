"""Whether an instruction gets through: policies that hear it, are deaf, cut it, or hear another row's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs

from tests.kit.questions import question_about, with_attributes
from tests.kit.stores import write_store
from tests.kit.toy_family import make_toy_policy
from vla_attention.analyze.commands.language import words_get_through
from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.engine.plumbing import look_at_words, unread_words
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import GivenInputs
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, KeyKnockout
from vla_attention.schemas.layout import Piece, Prompt
from vla_attention.schemas.plumbing import Plumbing
from vla_attention.schemas.stores.store_format import Recording

RECORDING = Recording((0,), (0,), (0,), (0, 1), "mean", 4, 23, frames=False)
UNCHANGED = Interventions()
TOLD = ("touch a cube", "lift the bowl", "push left now", "lift the bowl")


def looked(policy: Any, *told: str, changes: Interventions = UNCHANGED) -> Plumbing:
    """What is found for a batch of calls with these instructions, under a run's interventions."""
    pictures = np.random.default_rng(0).integers(0, 255, (len(told), 4, 4, 3), dtype=np.uint8)
    calls = [
        PolicyCall(
            policy.prepare_again(GivenInputs({"view": picture}, {}, np.zeros(8), text)), 5, CallContext(0, i, 0), 0, ""
        )
        for i, (picture, text) in enumerate(zip(pictures, told, strict=True))
    ]
    caller = Caller(policy, RECORDING, RunChanges(changes, dict(enumerate(TOLD))))
    before, made = torch.get_rng_state(), caller.make(calls)
    found = look_at_words(caller, calls, made, 0)
    assert found is not None
    assert torch.equal(before, torch.get_rng_state())
    return found


def toy(**methods: Any) -> Any:
    plain = make_toy_policy("weights", 4)
    return type("Changed", (type(plain),), methods)()


def fed_row_0(self: Any, inputs: Any, seeds: Any, recorders: Any) -> Any:
    keys = inputs[0].tensors["keys"][4:]
    mixed = [replace(one, tensors={"keys": torch.cat([one.tensors["keys"][:4], keys])}) for one in inputs]
    return [self.act(*each) for each in zip(mixed, seeds, recorders, strict=True)]


def fed_its_own(self: Any, inputs: Any, seeds: Any, recorders: Any) -> Any:
    return [self.act(*each) for each in zip(inputs, seeds, recorders, strict=True)]


def deaf(self: Any, given: GivenInputs) -> Any:
    return type(self).__mro__[1].prepare_again(self, replace(given, instruction="do the same"))


def test_a_policy_that_hears():
    found = looked(toy(), TOLD[0])
    assert found.problem == ""
    assert found.row_of_another is None
    assert found.input_changed
    assert found.rows_changed > 0
    assert found.action_changed > 0


@pytest.mark.parametrize(("act_batch", "mixed"), [(fed_row_0, True), (fed_its_own, False)])
def test_a_batch_in_which_all_rows_get_row_0s_text(act_batch, mixed):
    found = looked(toy(act_batch=act_batch), *TOLD)
    assert found.row_of_another is mixed
    assert bool(found.problem) == mixed


def test_a_prompt_that_is_cut_before_the_model():
    assert looked(toy(), "touch a cube and let it go").unread == ("and", "let", "it", "go")
    text = "Task: pick_up the bowl;"
    pieces = tuple(Piece(i, text[a:b], a, b) for i, (a, b) in enumerate([(0, 6), (6, 10), (10, 13), (13, 17)]))
    assert unread_words(Prompt(text, pieces, (6, 22)), "pick up the bowl") == ("bowl",)
    assert unread_words(Prompt(text, (*pieces, Piece(4, text[17:], 17, 23)), (6, 22)), "Pick up the bowl.") == ()
    assert unread_words(Prompt(text, (), (6, 22)), "pick up the bowl") == ()


def test_a_policy_whose_input_has_no_words():
    found = looked(toy(prepare_again=deaf), "do the same")
    assert found.input_changed is False
    assert found.action_changed == 0
    assert found.problem


def test_a_policy_that_knows_the_sentences_of_its_tasks_alone():
    def known(self: Any, given: GivenInputs) -> Any:
        if given.instruction not in TOLD:
            raise BadArgument("no encoding")
        return type(self).__mro__[1].prepare_again(self, given)

    found = looked(toy(prepare_again=known), TOLD[0])
    assert found.other in TOLD[1:]
    assert found.input_changed

    def only_its_own(self: Any, given: GivenInputs) -> Any:
        if given.instruction != TOLD[0]:
            raise BadArgument("no encoding")
        return type(self).__mro__[1].prepare_again(self, given)

    found = looked(toy(prepare_again=only_its_own), TOLD[0])
    assert (found.other, found.input_changed, found.why_not) == ("", None, "no encoding")


def test_words_that_the_run_knocks_out_are_not_in_the_other_sentence():
    knocked_out = Interventions(keys=(KeyKnockout("word:cube", queries="action"),))
    found = looked(make_toy_policy("weights", 4), TOLD[0], changes=knocked_out)
    assert (found.input_changed, found.action_changed) == (None, None)
    assert "word:cube" in found.why_not


def test_the_answer_is_of_the_process_that_heard_least(tmp_path):
    write_store(tmp_path / "a.zarr")
    question = question_about(tmp_path / "a.zarr")
    assert words_get_through(question) == []
    hears = Plumbing("a", "b", input_changed=True, rows_changed=0.5, action_changed=0.1)
    for plumbing, action in [(hears, 0.1), (structs.replace(hears, action_changed=1e-7), 1e-7)]:
        of = [hears, plumbing]
        items = [
            replace(item, episode=with_attributes(item.episode, plumbing=one))
            for item, one in zip(question.selected, of, strict=False)
        ]
        (finding,) = words_get_through(replace(question, selected=tuple(items)))
        assert (finding.numbers["action"], finding.numbers["calls"]) == (action, 2)
