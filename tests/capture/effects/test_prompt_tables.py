"""Prompt tables: what is read and refused, and that each sentence's effect is what a rerun with it gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.capture.effects.test_measurement import call_of
from tests.capture.interventions.test_interventions_on_policies import policy_named
from tests.capture.rerun.conftest import pi_store as pi_store
from vla_attention.capture.__main__ import main
from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.effects.conditions import planned_effects
from vla_attention.capture.effects.measurement import EffectMeasurement
from vla_attention.capture.effects.prompt_tables import SHIPPED, read_prompt_table, with_rows
from vla_attention.capture.environments.suites import find_suite, list_tasks
from vla_attention.schemas.effects import OtherPrompt
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import open_store

TASKS = {0: "lift the red cube", 1: "stack the red cube on top of the green cube"}
TABLE = (
    "task,sentence,kind\n0,raise the cube that is red please,paraphrased\n"
    "stack the red cube on top of the green cube,touch nothing,contradicted\n0,,empty\n0,,shuffled\n"
    "0,Lift the red cube,written otherwise\n0,lift the red cube.,written otherwise\n"
)
TOML = """[[prompt]]
task = 0
sentence = "raise the cube that is red please"
kind = "paraphrased"
"""


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("a.csv", "", "no row"),
        ("a.csv", "task,sentence,kind\n", "no row"),
        ("a.csv", "task,text,kind\n0,a,empty\n", "line 2: .*task, text, kind; .*task, sentence, kind"),
        ("a.csv", "task,sentence,kind\n0,a,b,c\n", "line 2"),
        ("a.csv", "task,sentence,kind\n0,a\n", "line 2"),
        ("a.csv", "task,sentence,kind\n7,go,paraphrased\n", "line 2: .*'7'.*lift the red cube"),
        ("a.csv", "task,sentence,kind\n0,go,paraphrase\n", "line 2: .*'paraphrased'"),
        ("a.csv", "task,sentence,kind\n0,=1+1,paraphrased\n", "line 2: .*formula"),
        ("a.csv", "task,sentence,kind\n0,go,empty\n", "line 2: .*'empty'"),
        ("a.csv", "task,sentence,kind\n0,,paraphrased\n", "line 2: .*'paraphrased'"),
        ("a.csv", "task,sentence,kind\n0,Go!,paraphrased\n0,go,contradicted\n", "line 3: Task 0 .*line 2"),
        ("a.csv", "task,sentence,kind\n0,Lift the red cube.,shuffled\n", "line 2: .*Lift.*no 'shuffled'.*task 0"),
        ("a.csv", "task,sentence,kind\n0,Lift a cube.,written otherwise\n", "line 2: .*'Lift a cube.'.*same words"),
        ("a.csv", "task,sentence,kind\n0,lift the red cube,written otherwise\n", "line 2: .*another case"),
        ("a.csv", "task,sentence,kind\n" + "0,Lift the red cube,written otherwise\n" * 2, "line 3: .*line 2"),
        ("a.csv", "task,sentence,kind\n" + "0,go,empty\n" * 100_000, "1,100,019 bytes; .* 1,000,000"),
        ("a.csv", b"\xff\xfe", "a.csv"),
        ("a.toml", "task = 1", r"\[\[prompt\]\]"),
        ("a.toml", f"{TOML}more = 1", "prompt 1: .*more"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(tmp_path, name, content, named):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(BadArgument, match=named):
        read_prompt_table(path, TASKS)


def test_csv_and_toml_are_read_alike(tmp_path):
    for name, text in (("a.csv", TABLE), ("a.toml", TOML)):
        (tmp_path / name).write_text(text)
    rows = read_prompt_table(tmp_path / "a.csv", TASKS)
    assert [(row.task_id, row.kind) for row in rows] == [
        (0, "paraphrased"), (1, "contradicted"), (0, "empty"), (0, "shuffled"),
        (0, "written otherwise"), (0, "written otherwise"),
    ]  # fmt: skip
    assert read_prompt_table(tmp_path / "a.toml", TASKS) == rows[:1]


@pytest.mark.parametrize("suite", ["cubes", "libero_spatial", "libero_object", "libero_goal", "libero_10"])
def test_our_own_tables_and_the_standard_prompts_are_of_every_task(suite):
    tasks = {task.task_id: (task.task_id, task.instruction, task.task_family) for task in list_tasks(find_suite(suite))}
    rows = read_prompt_table(SHIPPED / f"{suite}.csv", {number: text for number, text, _ in tasks.values()})
    per_task = {number: [row.kind for row in rows if row.task_id == number] for number in tasks}
    assert {*map(tuple, per_task.values())} == {("paraphrased", "paraphrased", "contradicted")}
    made = with_rows(EffectSettings((), prompts="standard"), suite, [tasks[0]])
    assert made.items == ("cameras",)
    kinds = [row.kind for row in made.rows]
    assert {row.task_id for row in made.rows} == {0}
    assert {"written otherwise", "empty", "shuffled", "other task", "paraphrased", "contradicted"} <= {*kinds}
    assert ("exchanged" in kinds) == (suite in ("cubes", "libero_object", "libero_10"))
    assert tasks[0][1] not in {row.sentence for row in made.rows}


def test_each_sentence_has_the_effect_of_a_rerun_with_it(pi_store, tmp_path):
    """Of another number of tokens, too; the call that is stored is the base's to the bit."""
    (tmp_path / "a.csv").write_text(TABLE)
    given = ["rerun", str(pi_store), "--check", "0", "--output"]
    assert main([*given, str(tmp_path / "all.zarr"), "--prompts", f"table:{tmp_path / 'a.csv'}"]) == 0
    made, base = open_store(tmp_path / "all.zarr"), open_store(pi_store)
    assert made.attributes.recording.effects.items == ("prompts",)
    texts = ("raise the cube that is red please", "touch nothing", "Lift the red cube", "lift the red cube.")
    for change in (*(f"text:{text}" for text in texts), "empty", "shuffled"):
        assert main([*given, str(tmp_path / f"{change[:12]}.zarr"), "--prompt", change]) == 0
    for episode, before in zip(made.episodes, base.episodes, strict=True):
        effects, change = episode.attributes.effects, episode.read("effects/change")
        assert (episode.read("actions") == before.read("actions")).all()
        prompts = [(i, one.prompt) for i, one in enumerate(effects.conditions) if one.prompt]
        assert len(prompts) == (5 if episode.attributes.task_id == 0 else 1)
        for number, prompt in prompts:
            name = (f"text:{prompt.text}" if prompt.text else prompt.kind)[:12]
            again = next(one for one in open_store(tmp_path / f"{name}.zarr").episodes if one.name == episode.name)
            entries = np.flatnonzero(np.array(effects.condition) == number)
            assert len(entries) == episode.attributes.num_replans
            expected = again.read("actions") - before.read("actions")
            np.testing.assert_allclose(change[entries] * np.array(effects.units), expected, atol=1e-5)
            assert np.abs(expected).max() > 1e-4


@pytest.mark.parametrize("name", ["pi05", "cosmos"])
def test_the_sentences_are_those_of_the_task_and_none_is_cut(name):
    policy, said = policy_named(name), list[str]()
    rows = OtherPrompt(0, "paraphrased", "open it"), OtherPrompt(1, "empty"), OtherPrompt(0, "contradicted", "go " * 99)
    planned = planned_effects(EffectSettings((), rows=rows), policy, 3)
    given, context, actions = call_of(policy)
    made = EffectMeasurement(policy, planned, {}, said.append).begin().measure(given, 11, actions, context)
    names = [one.name for one in made.conditions if one.prompt]
    assert names[0] == "prompt_paraphrased_open_it"
    assert len(names) == 2
    measured = {made.conditions[number].name: change for number, change in zip(made.measured, made.change, strict=True)}
    again = policy.act(policy.prepare_again(replace(given.given, instruction="open it")), 11)
    np.testing.assert_allclose(measured[names[0]] * made.units, again - actions, atol=1e-5)
    assert names[1] not in measured
    assert len(said) == 1
