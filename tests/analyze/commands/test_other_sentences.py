"""Effects of other sentences, by what they are to the task's own: planted sizes, and planted directions."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from msgspec import structs

from tests.kit.questions import question_about
from tests.kit.stores import StoreSpec, num_steps, small_steps, write_store
from tests.kit.tokens import INSTRUCTIONS
from vla_attention.analyze.commands.effects import effects
from vla_attention.analyze.core.directions import directions, things_of_sentences
from vla_attention.capture.interventions.condition_name import condition_name
from vla_attention.capture.store.replan_records import RecordedSteps, ReplanEffects
from vla_attention.schemas.effects import EffectItem, OtherPrompt
from vla_attention.schemas.interventions import Interventions, NoiseChange

ROWS = (
    OtherPrompt(0, "paraphrased", "set it down"),
    OtherPrompt(0, "contradicted", "leave it"),
    OtherPrompt(0, "other task", "open the cabinet"),
    OtherPrompt(0, "exchanged", INSTRUCTIONS[0]),
)
CONDITIONS = (Interventions("noise", noise=NoiseChange(1)), *(Interventions(prompt=row.change) for row in ROWS))
SIZES = (0.5, 0.1, 1.5, 2.0, 1.0)
#: How far 1 of the action moves the hand, and where the cabinet is, in metres.
STEP, CABINET = 0.02, np.array([0.3, -0.4, 1.2])
SPEC = StoreSpec(tasks=(0, 1, 2), episodes=4, mantissa_bits=23)
CABINETS = {("open", "the", "cabinet"): frozenset({"wooden_cabinet_1"})}


def actions_of(task, episode, replans):
    return np.random.default_rng([9, task, episode]).normal(size=(replans, 5, 7))


def noise_of(task, episode):
    return 1.0 + 0.1 * ((task + 2 * episode) % 3)


def plant(task, episode, replan, tokens):
    """Every number changes by the size, in the sign of a coin; by other noise in each episode by another one."""
    signs = np.random.default_rng([task, episode, replan]).choice([-1.0, 1.0], (len(SIZES), 5, 7))
    change = (signs * np.array(SIZES)[:, None, None]).astype(np.float32)
    change[0] *= noise_of(task, episode)
    named = tuple(structs.replace(one, name=one.name or condition_name(one)) for one in CONDITIONS)
    cut = np.zeros((len(SIZES), tokens.layout.num_keys), np.float32)
    items = (EffectItem("noise"), *(EffectItem("prompt", row.kind, instead=row.sentence) for row in ROWS))
    return ReplanEffects(named, items, (1.0,) * 7, tuple(range(len(SIZES))), change, {"joint": cut})


def moves(spec, task, episode, steps):
    """The hand moves by `STEP` times the executed actions, and the cabinet stays."""
    told = actions_of(task, episode, spec.num_replans).reshape(-1, 7)[:steps]
    made = small_steps(spec, task, episode, steps)
    known = structs.replace(made.attributes, bodies=("hand", "plate_1", "wooden_cabinet_1"), first_touch=(None,) * 3)
    poses = np.zeros((steps + 1, 3, 7), np.float32)
    poses[1:, 0, :3] = STEP * np.cumsum(told[:, :3], axis=0)
    poses[:, 2, :3] = CABINET
    poses[..., 3] = 1.0
    return RecordedSteps(known, poses, made.gripper, told.astype(np.float32))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    spec = replace(SPEC, plant_effects=plant, plant_actions=actions_of, plant_steps=moves)
    return write_store(tmp_path_factory.mktemp("prompts") / "a.zarr", spec=spec)


def test_kinds_have_the_planted_sizes_beside_the_noise(store):
    result = effects(question_about(store, intervals="these-tasks"))
    table = {row["sentence"]: row for row in result["effects_prompts"].iter_rows(named=True)}
    tokens, ends = question_about(store).selected[0].tokens, []
    for task, episode in product(SPEC.tasks, range(SPEC.episodes)):
        steps = num_steps(SPEC, episode)
        of_replans = [
            plant(task, episode, replan, tokens).change[:, : min(5, steps - 5 * replan), :3].sum(axis=1)
            for replan in range(SPEC.num_replans)
        ]
        ends.append(np.linalg.norm(of_replans, axis=2).mean(axis=0))  # (condition,)
    noise, *sizes = np.mean(ends, axis=0)
    for row, size in zip(ROWS, sizes, strict=True):
        assert table[row.kind]["effect"] == pytest.approx(100 * STEP * size, rel=1e-4)
        assert table[row.kind]["over_noise"] == pytest.approx(size / noise, rel=1e-4)
        assert (table[row.kind]["than_noise"], table[row.kind]["num_episodes"]) == (
            "less" if row.kind == "paraphrased" else "more", 12,
        )  # fmt: skip
    assert result["effects_items"].filter(item_kind="word", than_noise="not tested").height
    assert effects(question_about(store), by=["task"])["effects_prompts"].height == len(ROWS) * 3


def test_the_steps_go_towards_the_named_thing_by_the_planted_metres(store):
    question = question_about(store)
    names = things_of_sentences(question.stores)
    assert names[tuple(INSTRUCTIONS[1].split())] == {"akita_black_bowl_1", "plate_1"}
    rows, unknown = directions(question.selected, names | CABINETS, STEP)
    assert (rows.height, unknown) == (12, 1)
    assert {*rows["sentence"]} == {"other task"}
    for row in rows.iter_rows(named=True):
        task, episode = row["task_id"], row["episode_index"]
        steps, actions = num_steps(SPEC, episode), actions_of(task, episode, SPEC.num_replans)
        expected = []
        for replan in range(SPEC.num_replans):
            line = CABINET - STEP * actions.reshape(-1, 7)[: 5 * replan, :3].sum(axis=0)
            line /= np.linalg.norm(line)
            executed = slice(0, min(5, steps - 5 * replan))
            change = plant(task, episode, replan, question.selected[0].tokens).change[3]
            told = actions[replan, executed, :3].sum(axis=0), change[executed, :3].sum(axis=0)
            expected.append([STEP * (one @ line) for one in told])
        unchanged, closer = np.mean(expected, axis=0)
        assert (row["unchanged"], row["closer"]) == (
            pytest.approx(unchanged, abs=1e-5),
            pytest.approx(closer, abs=1e-5),
        )
        assert row["changed"] == pytest.approx(unchanged + closer, abs=1e-5)
