"""`language` on policies that listen, that are deaf or stubborn, and on scenes in which some goals count for nobody."""

from __future__ import annotations

import itertools
import json
from math import comb, factorial
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from benchmarks.null_stores import PARTLY_DEAF, of_a_listener, says_it_listens
from tests.kit.archives import example_store, unpacked
from tests.kit.made_up_behaviour import COLOURS, did, goals_of
from tests.kit.paths import GOLDEN
from tests.kit.questions import question_about
from tests.kit.stores import rerun_source, small_steps, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.commands.language import language
from vla_attention.analyze.core.behaviour import with_choices
from vla_attention.analyze.core.listening import TOO_FEW, listens, parts_heard
from vla_attention.analyze.core.perturbations import by_suite
from vla_attention.analyze.statistics.exact_tests import at_least, fewer, mcnemar, share_interval, share_shown, shuffled
from vla_attention.analyze.statistics.many_looks import SHOWN_AT, holm
from vla_attention.schemas.interventions import Interventions, PromptChange

EIGHT = [task for task in range(3) for _ in range(8)]


def said(*args, **options):
    return listens(with_choices(did(*args, **options)))


@pytest.mark.parametrize(("store", "right", "p"), [("cubes", 6, 1 / 90), ("cubes_one_colour", 2, 1.0)])
def test_the_shipped_pair(store, right, p):
    found = language(question_about(example_store(store)))
    reached, listens = found.findings[:2]
    # To the policy all colours are one word, and 'wave hello twice' is another sentence.
    assert reached.numbers["action"] > 0.1
    assert (listens.numbers["right"], listens.numbers["n"]) == (right, 6)
    assert listens.numbers["p"] == pytest.approx(p)
    assert found["told_and_did"]["episodes"].sum() == 6
    # One that does not listen is asked what it was trained on.
    asks_the_data = listens.next_step.startswith("vla-attention data ")
    assert asks_the_data == (store == "cubes_one_colour")
    if store == "cubes_one_colour":
        assert "blue cube" in listens.sentence


def test_a_policy_that_listens_and_one_whose_tasks_the_pictures_tell():
    does = [(task, {task: 9}) for task in EIGHT]
    found = said(does)
    assert (found.numbers["right"], found.numbers["n"], found.limit) == (24, 24, "")
    assert found.numbers["p"] < 0.001
    assert "listens" in found.sentence
    apart = said(does, state=None)
    assert "listens" not in apart.sentence
    assert apart.limit


def test_too_few_episodes_of_one_scene_are_not_said_to_have_scenes_of_their_own():
    found = said([(task, {task: 9}) for task in (0, 1)])
    assert (found.numbers["verdict"], found.numbers["p"], found.numbers["expected"]) == (TOO_FEW, 0.5, 1.0)
    assert "own initial states" not in found.limit
    assert "0.5" in found.limit


@pytest.mark.parametrize("course", [{2: 5}, {0: 3, 1: 6, 2: 9}, {}, {0: 5, 1: 5}])
def test_a_policy_that_does_the_same_whatever_it_is_told(course):
    """Also one that tries everything, whose episodes all end well because each ends with its own goal."""
    found = said([(task, course) for task in EIGHT])
    assert found.numbers["p"] == 1.0


def test_a_goal_reached_on_the_way_to_the_told_one_is_said():
    found = said([(task, {0: 3, 1: 6, 2: 9}) for task in EIGHT])
    assert found.numbers["right"] == 8
    assert "16 solved episodes" in found.limit


def test_episodes_that_reached_nothing_are_counted():
    found = said([(task, {task: 9} if i % 2 else {}) for i, task in enumerate(EIGHT)])
    assert (found.numbers["right"], found.numbers["n"], found.numbers["nothing_reached"]) == (12, 24, 12)


def test_a_part_of_a_told_goal_counts_for_nobody():
    """Opened on the way to putting something in: neither done instead, nor evidence."""
    goals = goals_of(
        {0: "open the drawer", 1: "open the drawer and put the bowl in", 2: "push the plate"},
        {0: ("open",), 1: ("open", "in")},
    )
    frame = with_choices(did([(1, {0: 3, 1: 9}), (1, {0: 4}), (2, {2: 5}), (2, {0: 2, 2: 8}), (0, {0: 3})], goals, ""))
    assert frame["did"].to_list() == [goals[1].instruction, None, "push the plate", "push the plate", "open the drawer"]
    assert frame["first"].to_list() == ["in\x1fopen", None, "goal_2", "goal_2", None]
    assert frame["left_out"].is_null().to_list() == [True, True, True, True, False]


def test_a_goal_that_held_at_the_beginning_counts_for_nobody():
    frame = with_choices(did([(0, {0: 9, 2: 0}), (1, {1: 9, 2: 0}), (2, {2: 0}), (0, {1: 3})]))
    assert frame["left_out"].is_null().to_list() == [True, True, False, True]
    assert frame["first"].to_list() == ["goal_0", "goal_1", None, "goal_1"]
    assert listens(frame).numbers["n"] == 3


def test_a_lift_touches_first_and_is_what_was_told():
    """Goals of another sentence template are on the way; what was reached is named by the told one's template."""
    goals = [*COLOURS, *goals_of({3: "lift the red cube", 4: "lift the blue cube"})]
    families = {
        **dict.fromkeys(range(3), "touch the COLOUR cube"),
        3: "lift the COLOUR cube",
        4: "lift the COLOUR cube",
    }
    plan = [(0, {0: 4}), (2, {2: 4}), (3, {0: 4, 3: 9}), (4, {2: 4, 4: 9}), (3, {2: 4, 4: 9})]
    frame = with_choices(did(plan, goals, families))
    assert frame["did"].to_list() == [goals[i].instruction for i in (0, 2, 3, 4, 4)]
    assert listens(frame).numbers["right"] == 4


def test_one_possible_goal_shows_nothing():
    found = said([(0, {0: 9})] * 10)
    assert "p" not in found.numbers
    assert "10 of 10" in found.sentence


def test_sentences_that_name_no_goal_are_no_test():
    found = said([(task, {task: 9}) for task in EIGHT], told="")
    assert "p" not in found.numbers


def test_scenes_are_shuffled_apart():
    """In each scene one goal is always reached; only all together it would look like listening."""
    other = [replace(goal, conditions=(f"elsewhere_{goal.task_id}",)) for goal in COLOURS]
    here = did([(0, {0: 9})] * 6 + [(1, {0: 9})] * 2)
    there = did([(1, {1: 9})] * 6 + [(0, {1: 9})] * 2, other, suite="other")
    assert listens(with_choices(pl.concat([here, there]))).numbers["p"] == 1.0


courses = st.lists(st.tuples(st.integers(0, 2), st.sampled_from([None, 0, 1, 2])), min_size=1, max_size=7)


@given(courses, st.randoms(use_true_random=False))
def test_p_is_the_share_of_all_shuffles_and_knows_neither_order_nor_names(pairs, random):
    told, done = [f"t{t}" for t, _ in pairs], [None if d is None else f"t{d}" for _, d in pairs]
    found = shuffled(told, done, [""] * len(pairs))
    matches = [sum(a == b for a, b in zip(way, done, strict=True)) for way in itertools.permutations(told)]
    assert found.p_value == pytest.approx(np.mean(np.array(matches) >= found.matches))
    assert found.expected == pytest.approx(np.mean(matches))
    assert found.least_p == pytest.approx(
        sum(way == tuple(told) for way in itertools.permutations(told)) / factorial(len(told))
    )
    order = random.sample(range(len(pairs)), len(pairs))
    names = dict(zip(("t0", "t1", "t2", None), [*random.sample(["x", "y", "z"], 3), None], strict=True))
    again = shuffled([names[told[i]] for i in order], [names[done[i]] for i in order], ["s"] * len(pairs))
    assert again == found


def test_strata_add_up():
    found = shuffled(["a", "b", "a", "b"], ["a", "b", "a", "b"], ["1", "1", "2", "2"])
    assert (found.p_value, found.expected) == (0.25, 2.0)


def test_many_episodes_are_exact_too():
    told = [str(i % 10) for i in range(200)]
    assert shuffled(told, told[1:] + told[:1], [""] * 200).p_value == pytest.approx(1.0)
    # 20 pairs of which 17 are won: as R's binom.test(17, 20)
    assert mcnemar(17, 3) == pytest.approx(0.002577, abs=1e-6)
    assert mcnemar(0, 0) == mcnemar(4, 4) == 1.0


def test_null_policies_are_said_to_listen_in_at_most_five_of_a_hundred():
    assert says_it_listens(400, planted=False) <= 0.05
    assert says_it_listens(40, planted=True) > 0.8


@pytest.mark.parametrize("policy", PARTLY_DEAF)
def test_who_hears_a_part_is_not_said_to_hear_the_rest(policy):
    rates = of_a_listener(policy, 40)
    assert rates["wrong"] <= 0.05
    assert rates["found"] >= 0.5 or policy == "pictures"


def test_a_policy_that_is_deaf_to_lifts_listens_to_touches_alone():
    goals = [*COLOURS, *goals_of({3: "lift the red cube", 4: "lift the green cube", 5: "lift the blue cube"})]
    families = {task: "touch the COLOUR cube" if task < 3 else "lift the COLOUR cube" for task in range(6)}
    plan = [(task, {task if task < 3 else 5: 5}) for task in range(6) for _ in range(4)]
    numbers = said(plan, goals, families).numbers
    assert (numbers["right"], numbers["n"], numbers["verdict"]) == (16, 24, "listens in part")
    assert (numbers["heard"], numbers["not_heard"]) == ("touch the COLOUR cube", "lift the COLOUR cube")
    # Who cannot lift is not deaf to it.
    weak = [(task, {task: 5} if task < 3 or number == 0 else {}) for task in range(6) for number in range(4)]
    numbers = said(weak, goals, families).numbers
    assert (numbers["heard"], numbers["not_heard"]) == ("touch the COLOUR cube", "")


def test_a_policy_that_hears_only_red_does_not_hear_green_as_well():
    found = said([(task, {0 if task == 0 else 1: 5}) for task in range(3) for _ in range(4)])
    assert (found.numbers["right"], found.numbers["n"]) == (8, 12)
    assert (found.numbers["heard"], found.numbers["not_heard"]) == ("red", "blue")
    rows = with_choices(did([(task, {0 if task == 0 else 1: 5}) for task in range(3) for _ in range(4)]))
    green = parts_heard(rows, SHOWN_AT).filter(item="green").row(0, named=True)
    assert (green["right"], green["num_episodes"], green["verdict"]) == (4, 4, "not shown")
    assert green["p"] == pytest.approx(2 * comb(8, 4) / comb(12, 4))  # Holm: the second of three


def test_where_the_pictures_tell_the_task_only_shared_states_count():
    """A policy that hears nothing: in the shared states it goes where it likes, else where the picture says."""
    shared = [did([(task, {state % 3: 5}) for task in range(3)], state=str(state)) for state in range(4)]
    alone = [did([(state % 3, {state % 3: 5})] * 3, state=str(state)) for state in range(4, 8)]
    numbers = listens(with_choices(pl.concat([*shared, *alone]).with_columns(episode_index=pl.int_range(24)))).numbers
    assert (numbers["right"], numbers["n"], numbers["p"], numbers["verdict"]) == (4, 12, 1.0, "not shown")


def test_intervals_of_shares():
    assert share_interval(30, 30) == pytest.approx((0.025 ** (1 / 30), 1.0))
    assert share_interval(0, 5) == pytest.approx((0.0, 1 - 0.025**0.2))
    low, high = share_interval(16, 24)
    assert (low, high) == pytest.approx((0.4468, 0.8437), abs=1e-4)  # R: binom.test(16, 24)
    assert at_least(16, 24, low) == pytest.approx(0.025)
    assert 1 - at_least(17, 24, high) == pytest.approx(0.025)
    assert at_least(1000, 3000, 0.5) == pytest.approx(1.0)
    assert fewer(0, 4, 8, 8) == pytest.approx(1 / comb(12, 4))
    assert fewer(4, 4, 8, 8) == 1.0


def test_what_a_run_of_this_size_would_show():
    told, n = [task for task in "abc" for _ in range(4)], 12
    share = share_shown(told, [""] * n, SHOWN_AT)
    needed = next(k for k in range(n + 1) if tail(told, k) <= SHOWN_AT)
    assert at_least(needed, n, share) == pytest.approx(0.8)
    assert share_shown(["a", "b"], ["", ""], SHOWN_AT) is None


def tail(told, least):
    """By drawing: the share of shuffles with at least so many matches."""
    generator, told = np.random.default_rng(0), np.array(told)
    return np.mean([(generator.permutation(told) == told).sum() >= least for _ in range(20_000)])


def test_claims_of_which_none_is_false():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([]) == []


def test_effects_say_which_words_decide_and_which_were_not_tested():
    question = question_about(unpacked(GOLDEN / "tables/stores/effects.tar.xz"))
    table = language(question)["word_effects"]
    golden = pl.read_parquet(GOLDEN / "tables/effects_effects/effects_summary.parquet")
    rows = golden
    for reader, ending in (("total", "_queries_all"), ("direct", "")):
        for word, value in table.filter(item_kind="word").drop_nulls("total").select("item", reader).iter_rows():
            condition = f"without_word_{word}{ending}"
            assert value == pytest.approx(rows.row(by_predicate=pl.col("condition") == condition, named=True)["effect"])
    assert table["item"][0] == "green"


def test_a_store_without_steps_names_the_next_step(tmp_path, capsys):
    store = write_store(tmp_path / "a.zarr")
    assert analyze(["language", str(store), "--output", str(tmp_path / "out"), "--no-plots"]) == 0
    assert "vla-attention capture" in capsys.readouterr().out
    first = json.loads((tmp_path / "out" / "result.json").read_text())["findings"][0]
    assert first["numbers"] == {}


def test_a_rerun_did_nothing_of_its_own(tmp_path):
    base = write_store(tmp_path / "base.zarr", plant_steps=small_steps)
    rerun = write_store(tmp_path / "rerun.zarr", plant_steps=small_steps, rerun_of=rerun_source(base))
    assert language(question_about(base)).findings[0].numbers["n"] == 4
    assert language(question_about(rerun)).findings[0].numbers == {}


def test_other_words_for_the_same_goal_are_a_test_of_it():
    found = said([(task, {task: 9}) for task in EIGHT], told="poke the crimson one", same=True)
    assert found.numbers["p"] < 0.001


def test_another_prompt_is_told_first(tmp_path):
    change = Interventions("other", prompt=PromptChange("text", text="go"))
    plain, told = (
        write_store(tmp_path / f"{name}.zarr", **more) for name, more in (("a", {}), ("b", {"interventions": change}))
    )
    assert len(language(question_about(plain)).about) < len(language(question_about(told)).about)


def test_other_words_for_the_told_goal_count_as_done():
    for told, same in (("Touch the RED cube.", False), ("hit the crimson cube", True)):
        asked = did([(0, {0: 5}), (0, {})], told=told, same=same)
        unknown = SimpleNamespace(attributes=SimpleNamespace(success=None))
        keys = asked.select("suite", "task_id", "episode_index").rows()
        question = SimpleNamespace(selected=[SimpleNamespace(key=key, episode=unknown) for key in keys])
        assert by_suite(question, asked, [])["did"].to_list() == [0.5]
        assert listens(with_choices(asked)).numbers == {"right": 1, "n": 2}
