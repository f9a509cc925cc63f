"""Sessions of `va.record`: what is in the store is what the policy computed, and nothing changes the policy."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import nn

import vla_attention as va
from tests.kit.small_torch_policy import (
    BLOCKS,
    HEADS,
    HORIZON,
    PROMPT,
    STEPS,
    WIDTH,
    SmallPolicy,
    given,
    small_layout,
)
from vla_attention.analyze.core.camera_maps import stored_picture
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.torch_policies.attention_calls import AttentionCall
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.capture.torch_policies.layout_check import check_layout
from vla_attention.capture.torch_policies.policy_layout import CallRule, LayoutForAnotherVersion, PromptText
from vla_attention.capture.torch_policies.prompts import PromptDoesNotFit
from vla_attention.capture.torch_policies.record import record
from vla_attention.capture.torch_policies.recorded_episodes import NothingRecorded
from vla_attention.capture.torch_policies.site_recorder import RowsDoNotMatch
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.capture.torch_policies.watch import NotFollowed
from vla_attention.schemas.errors import BadArgument, UnknownName
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import knockout
from vla_attention.schemas.layout import Role, Span
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import RunMismatch, StoreExists
from vla_attention.schemas.stores.verify import verify_store

KEYS = 4 + PROMPT + 1 + HORIZON


@pytest.fixture
def policy() -> SmallPolicy:
    return SmallPolicy()


def start(path, policy, **changes):
    changes = {
        "layout": small_layout(),
        "tokenizer": policy.tokenizer,
        "denoise_steps": "all",
        "durable": False,
    } | changes
    return record(path / "a.zarr", policy, **changes)


def fill(run, policy, replans=2, number=0, text="pick the bowl", broken=False, **facts):
    facts = {"task_id": 0, "episode_index": number, "instruction": text, "seed": 7} | facts
    with run.episode(**facts) as episode:
        for step in range(replans):
            inputs = given(seed=10 * number + step, text=text)
            with episode.replan(
                env_step=5 * step, frames={"front": inputs["pictures"]}, state=inputs["states"]
            ) as replan:
                replan.actions = policy.act(**inputs)
                if broken and step == 1:
                    raise TypeError("no pixels")
        episode.success = True
    return episode


def one_call(run, policy, inputs=None, calls=1, **replan):
    """An episode of one replan."""
    with (
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
        episode.replan(env_step=0, **replan),
    ):
        for _ in range(calls):
            policy.act(**(inputs or given()))
    return episode


def stored(path):
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return store


def computed(policy, inputs):
    """Logits and values by the block's number and denoise step, of the action queries, computed by hand."""
    for block in policy.blocks:
        block.attention.kept = []
    policy.act(**inputs)
    found = [block.attention.kept[1:] for block in policy.blocks]
    for block in policy.blocks:
        block.attention.kept = None
    return found


def test_what_is_fitted_in_says_what_of_it_shows(tmp_path):
    """A picture of 4 x 8 in the middle of 8 x 8: of each of the 2 x 2 patches one half shows it."""
    policy = SmallPolicy()
    layout = small_layout(cameras=(va.CameraPicture("front", fit="pad"),))
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout, tokenizer=policy.tokenizer) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
        episode.replan(env_step=0, frames={"front": np.full((4, 8, 3), 9, np.uint8)}) as replan,
    ):
        replan.actions = policy.act(**given())
    groups = va.open(tmp_path / "a.zarr").analyze()["tasks_groups"].filter(layer="layers_avg")
    counted = dict(groups.select("group", "keys").iter_rows())
    assert (counted["visual"], counted["border"]) == (2.0, 2.0)


def test_the_rows_are_those_that_the_policy_computes(tmp_path, policy):
    with start(tmp_path, policy, bits=23) as run:
        fill(run, policy)
    episode = stored(tmp_path).episodes[0]
    rows = episode.read("joint/rows")
    assert rows.shape == (2, BLOCKS, STEPS, HEADS, 1, KEYS)
    for replan in range(2):
        for layer, calls in enumerate(computed(policy, given(seed=replan))):
            for step, (logits, _) in enumerate(calls):
                expected = logits.softmax(-1)[0].mean(1).numpy()
                np.testing.assert_allclose(rows[replan, layer, step, :, 0], expected, atol=2e-6)
    assert 0 < run.largest_error < 1e-5
    assert float(episode.attributes.provenance["largest P·V error"]) == pytest.approx(run.largest_error, rel=1e-2)


def test_all_queries_of_chosen_layers_heads_and_steps(tmp_path, policy):
    with start(tmp_path, policy, bits=23, queries="all", layers=[2, 0], heads=[1], denoise_steps=("last", 1)) as run:
        fill(run, policy, replans=1)
    rows = stored(tmp_path).episodes[0].read("joint/rows")
    assert rows.shape == (1, 2, 2, 1, HORIZON, KEYS)
    calls = computed(policy, given(seed=0))
    for i, layer in enumerate((0, 2)):
        for j, step in enumerate((1, STEPS - 1)):
            np.testing.assert_allclose(rows[0, i, j, 0], calls[layer][step][0].softmax(-1)[0, 1].numpy(), atol=2e-6)


def test_actions_are_bit_equal_with_recording(tmp_path, policy):
    expected = [policy.act(**given(seed=step)) for step in range(2)]
    with (
        start(tmp_path, policy) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
    ):
        for step in range(2):
            with episode.replan(env_step=step):
                assert torch.equal(policy.act(**given(seed=step)), expected[step])
    assert torch.equal(policy.act(**given(seed=0)), expected[0])


def test_contributions_are_those_of_the_values_and_the_projection(tmp_path, policy):
    with start(tmp_path, policy) as run:
        fill(run, policy, replans=1)
    episode = stored(tmp_path).episodes[0]
    gram = episode.read("joint/contribution")[0]
    segments, roles = episode.attributes.segments["joint"], episode.read("joint/key_role")[0]
    spans = small_layout().sites[0].keys
    members = [
        [
            key
            for key in range(KEYS)
            if spans.spans[spans.span_of_key()[key]].name == one.span and Role(roles[key]).label == one.role
        ]
        for one in segments
    ]
    for layer, calls in enumerate(computed(policy, given(seed=0))):
        weight = policy.blocks[layer].attention.out.weight.detach()
        for step, (logits, values) in enumerate(calls):
            rows = logits.softmax(-1)[0]
            parts = [rows[:, :, keys] @ values[0][:, keys] for keys in [*members, list(range(KEYS))]]
            vectors = torch.stack([part.transpose(0, 1).flatten(1) @ weight.T for part in parts], dim=1)
            expected = (vectors @ vectors.transpose(1, 2)).mean(0)
            np.testing.assert_allclose(gram[layer, step], expected.detach().numpy(), atol=1e-5)


def test_masks_pieces_and_the_callers_facts_are_stored(tmp_path, policy):
    with start(tmp_path, policy, suite="my_robot", checkpoint="mine", untrained=True, mirrored="front") as run:
        fill(run, policy, task_name="bowl", task_family="pick A")
    store = stored(tmp_path)
    episode = store.episodes[0]
    labels = [Role(code).label for code in episode.read("joint/key_role")[0]]
    assert labels[4:10] == ["bos", "instruction", "instruction", "instruction", "template", "padding"]
    prompt = episode.attributes.prompts[0]
    assert prompt.text == " pick the bowl\n"
    assert prompt.instruction_text == "pick the bowl"
    assert [(piece.key, piece.text) for piece in prompt.pieces] == [(5, " pick"), (6, " the"), (7, " bowl"), (8, "\n")]
    assert episode.read("noise_seed").tolist() == [7, 7]
    assert episode.read("env_step").tolist() == [0, 5]
    assert episode.attributes.success is True
    assert episode.attributes.num_steps == 0  # the loop did not say it
    assert (episode.attributes.task_name, episode.attributes.task_family) == ("bowl", "pick A")
    np.testing.assert_array_equal(episode.read("actions")[1], policy.act(**given(seed=1))[0].double().numpy())
    np.testing.assert_allclose(episode.read("state")[1], given(seed=1)["states"][0].numpy())
    picture = (given(seed=1)["pictures"][0].permute(1, 2, 0) * 255).round().byte().numpy()
    np.testing.assert_array_equal(episode.read("frames/front")[1], picture)
    # Stored as given, and shown with left on the left.
    item = ask([store], AnalysisSettings()).selected[0]
    np.testing.assert_array_equal(stored_picture(item, "front", 1), picture[:, ::-1])
    root = store.attributes
    assert (root.protocol.name, root.protocol.suite) == ("recorded", "my_robot")
    assert root.policy.untrained
    assert root.provenance["difference to own setting"] == "not measured"
    assert np.allclose(episode.read("denoise_time"), [1, 0.75, 0.5, 0.25])


def test_an_episode_may_know_almost_nothing(tmp_path, policy):
    with (
        start(tmp_path, policy, tokenizer=None) as run,
        run.episode(task_id=3, episode_index=0, instruction="") as episode,
        episode.replan(env_step=0),
    ):
        policy.act(**given())
    store = stored(tmp_path)
    attributes = store.episodes[0].attributes
    assert attributes.success is None
    assert not {"state", "actions", "noise_seed"} & set(attributes.arrays)
    labels = [Role(code).label for code in store.episodes[0].read("joint/key_role")[0]]
    assert labels[4:10] == ["instruction"] * 5 + ["padding"]
    assert va.open(tmp_path / "a.zarr").analyze()["tasks"] is not None


def test_blocks_that_answer_from_a_queue_are_dropped_and_counted(tmp_path, policy):
    with (
        start(tmp_path, policy) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
    ):
        for step in range(6):
            with episode.replan(env_step=step) as replan:
                if step % 3 == 0:
                    policy.act(**given(seed=step))
            assert replan.recorded is (step % 3 == 0)
    assert (run.num_dropped, episode.num_dropped, episode.num_replans) == (4, 4, 2)
    episode = stored(tmp_path).episodes[0]
    assert episode.read("env_step").tolist() == [0, 3]
    assert episode.attributes.provenance["replan blocks without attention"] == "4"


def test_an_episode_without_attention_is_an_error(tmp_path, policy):
    with start(tmp_path, policy) as run:
        with pytest.raises(NothingRecorded, match=r"\b1 replan"):
            one_call(run, policy, calls=0)
        assert not run.has(0, 0)


def test_two_policy_calls_in_one_block_are_an_error(tmp_path, policy):
    with start(tmp_path, policy) as run, pytest.raises(CallsDoNotFit, match=r" 4 times .*block 0: 8"):
        one_call(run, policy, calls=2)


def test_a_batch_in_a_single_episode_is_an_error(tmp_path, policy):
    with start(tmp_path, policy) as run, pytest.raises(CallsDoNotFit, match=r"batch of 2, .*run\.episodes"):
        one_call(run, policy, given(batch=2))


def test_an_exception_drops_the_episode_and_only_it(tmp_path, policy):
    with start(tmp_path, policy) as run:
        fill(run, policy)
        with pytest.raises(TypeError, match="pixels"):
            fill(run, policy, number=1, replans=2, broken=True)
        assert run.has(0, 0)
        assert not run.has(0, 1)
        fill(run, policy, number=1)
    assert [one.name for one in stored(tmp_path).episodes] == ["task000_episode000", "task000_episode001"]
    assert not (tmp_path / "a.zarr" / ".writing").exists()


def test_resuming_goes_on_and_refuses_another_run(tmp_path, policy):
    with start(tmp_path, policy) as run:
        fill(run, policy)
        with pytest.raises(StoreExists, match="task000_episode000"):
            fill(run, policy)
    with pytest.raises(StoreExists), start(tmp_path, policy):
        pass
    with start(tmp_path, policy, resume=True) as run:
        assert run.has(0, 0)
        fill(run, policy, number=1)
    with (
        pytest.raises(RunMismatch, match=r"mantissa_bits .*10.*12"),
        start(tmp_path, policy, resume=True, bits=12),
    ):
        pass
    with pytest.raises(RunMismatch, match="digest"), start(tmp_path, SmallPolicy(seed=1), resume=True):
        pass
    other = small_layout(rules=(*small_layout().rules, CallRule("vision.*", None)))
    with pytest.raises(RunMismatch, match="layout"), start(tmp_path, policy, resume=True, layout=other):
        pass
    with pytest.raises(RunMismatch, match="camera"), start(tmp_path, policy, resume=True, mirrored=["front"]):
        pass
    with start(tmp_path, policy, overwrite=True, bits=12) as run:
        assert not run.has(0, 0)


@pytest.mark.parametrize(
    ("changes", "error", "named"),
    [
        ({"mirrored": ["wrist"]}, UnknownName, "'wrist'"),
        ({"heads": [2]}, BadArgument, "2; .*0 to 1"),
        ({"resume": True, "overwrite": True}, BadArgument, "resume=True .*overwrite=True"),
        ({"layout": small_layout(versions={"torch": ("1.0",)})}, LayoutForAnotherVersion, r"torch 1\.0"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, policy, changes, error, named):
    with pytest.raises(error, match=named):
        start(tmp_path, policy, **changes)
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize(
    ("inputs", "error", "named"),
    [
        ({"frame": {}}, UnknownName, "'frame'.*'frames'"),
        ({"frames": {"wrist": np.zeros((8, 8, 3), np.uint8)}}, UnknownName, "'wrist'"),
        ({"frames": {"front": torch.randn(3, 8, 8) * 9}}, BadArgument, "front"),
        ({"prompt": ["a"]}, PromptDoesNotFit, " 1 .* 6 "),
    ],
)
def test_wrong_inputs_are_named(tmp_path, policy, inputs, error, named):
    with start(tmp_path, policy) as run, pytest.raises(error, match=named):
        one_call(run, policy, **inputs)


class TextEncoder(nn.Module):
    """As a T5 encoder with tied weights: `shared` is a module of its own, and the encoder calls another one."""

    def __init__(self, embedding, embed=lambda self, ids: self.embed_tokens(ids)):
        super().__init__()
        self.embed_tokens, self.shared = embedding, nn.Embedding.from_pretrained(embedding.weight)
        self.places, self.embed = nn.Embedding(32, WIDTH), embed

    def forward(self, ids):
        self.places(torch.arange(12))
        return self.embed(self, ids)


def with_encoder(*embed):
    policy = SmallPolicy()
    policy.words = TextEncoder(policy.words, *embed)
    return policy


def encoded(embedding):
    return small_layout(text=PromptText(("prompt",), embedding))


@pytest.mark.parametrize("changes", [{}, {"contributions": False}, {"interventions": knockout("role:state")}])
def test_an_embedding_that_is_not_called_is_refused_by_name(tmp_path, changes):
    policy = with_encoder()
    with start(tmp_path, policy, layout=encoded("words.shared"), **changes) as run:
        sentence = r"'words\.shared'.*'words\.embed_tokens' \(1, 6\).* 'words\.places' \(12,\).*PromptText\.embedding"
        with pytest.raises(PromptDoesNotFit, match=sentence):
            one_call(run, policy)
        # Where the caller gives the pieces, nobody needs the ids.
        one_call(run, policy, prompt=[None, "pick", " the", " bowl", None, None])
    with start(tmp_path / "right", policy, layout=encoded("words.embed_tokens"), **changes) as run:
        one_call(run, policy)
    for path in (tmp_path, tmp_path / "right"):
        labels = [Role(code).label for code in stored(path).episodes[0].read("joint/key_role")[0][5:10]]
        assert labels == ["instruction"] * 3 + ["template", "padding"]


def test_masks_give_the_coverage_of_objects(tmp_path, policy):
    objects = [SceneObject("table", "fixture", False), SceneObject("bowl", "object", True)]
    mask = np.zeros((16, 16), int)
    mask[:8, :4] = 1
    with (
        start(tmp_path, policy) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl", objects=objects) as episode,
        episode.replan(env_step=0, masks={"front": mask}),
    ):
        policy.act(**given())
    coverage = stored(tmp_path).episodes[0].read("objects/front")
    np.testing.assert_allclose(coverage[0, :, 1], [0.5, 0, 0, 0])


def test_pieces_that_have_no_keys_are_refused(tmp_path, policy):
    with start(tmp_path, policy, layout=small_layout(text=None)) as run, pytest.raises(PromptDoesNotFit):
        one_call(run, policy, prompt=[None, "pick", " the", " bowl", None, None])


class Writer(nn.Module):
    """Embeds what it was told at once, then the tokens that it writes, one by one; `again`: all of them again."""

    def __init__(self, table, again):
        super().__init__()
        self.table, self.again = table, again

    def forward(self, ids):
        told = self.table(ids[:, :4])
        written = [self.table(ids[:, [place]]) for place in (4, 5)]
        return self.table(ids) if self.again else torch.cat([told, *written], dim=1)


@pytest.mark.parametrize("again", [False, True])
def test_a_subtask_that_the_policy_writes_has_a_span_of_its_own(tmp_path, again):
    policy = SmallPolicy()
    policy.words = Writer(policy.words, again)
    (joint,) = small_layout().sites
    image, _, *others = joint.keys.spans
    spans = (image, Span("prompt", "text", 4, 8), Span("subtask", "text", 8, 10), *others)
    site = replace(joint, keys=replace(joint.keys, spans=spans), role_of_span={**joint.role_of_span, "subtask": "text"})
    text = PromptText(("prompt",), "words.table")
    with (
        start(tmp_path, policy, layout=small_layout(sites=(site,), text=text)) as run,
        pytest.raises(PromptDoesNotFit) if again else nullcontext(),
    ):
        one_call(run, policy, given(text="pick the bowl plate"))
    text = replace(text, generated=("subtask",))
    with start(tmp_path / "named", policy, layout=small_layout(sites=(site,), text=text)) as run:
        one_call(run, policy, given(text="pick the bowl plate"))
    episode = stored(tmp_path / "named").episodes[0]
    pieces = {piece.key: piece.text for piece in episode.attributes.prompts[0].pieces}
    assert pieces == {5: " pick", 6: " the", 7: " bowl", 8: " plate", 9: "\n"}
    labels = [Role(code).label for code in episode.read("joint/key_role")[0][4:10]]
    assert labels == ["bos", "instruction", "instruction", "instruction", "text", "text"]


def test_a_prompt_may_be_given_as_pieces(tmp_path, policy):
    pieces = [None, "pick", " the", " bowl", None, None]
    with start(tmp_path, policy, tokenizer=None) as run:
        one_call(run, policy, prompt=pieces)
    episode = stored(tmp_path).episodes[0]
    assert [piece.key for piece in episode.attributes.prompts[0].pieces] == [5, 6, 7]
    labels = [Role(code).label for code in episode.read("joint/key_role")[0]]
    assert labels[4:10] == ["template", "instruction", "instruction", "instruction", "template", "padding"]


def test_a_call_of_another_thread_is_not_taken_for_the_block_s(tmp_path, policy):
    """The policy answers from its queue, and meanwhile another client of a server has it compute."""
    with ThreadPoolExecutor(1) as pool, start(tmp_path, policy) as run, pytest.raises(NotFollowed):  # noqa: PT012
        one_call(run, policy, calls=1)
        with run.episode(task_id=0, episode_index=1, instruction="pick the bowl") as episode:
            with episode.replan(env_step=0):
                policy.act(**given())
            with episode.replan(env_step=5):
                pool.submit(policy.act, **given()).result()
    assert len(stored(tmp_path).episodes) == 1


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_other_types_of_numbers(tmp_path, dtype):
    policy = SmallPolicy().to(dtype)
    inputs = {name: value.to(dtype) if name != "texts" else value for name, value in given().items()}
    expected = policy.act(**inputs)
    with start(tmp_path, policy) as run:
        one_call(run, policy, inputs)
    assert torch.equal(policy.act(**inputs), expected)
    root = stored(tmp_path).attributes
    assert root.policy.config["dtype"] == str(dtype).removeprefix("torch.")


def test_rows_that_do_not_reproduce_the_kernel_are_refused(tmp_path, policy, monkeypatch):
    exact = AttentionCall.rows
    monkeypatch.setattr(AttentionCall, "rows", lambda self, *where: exact(self, *where).roll(1, dims=-1))
    with (
        start(tmp_path, policy) as run,
        pytest.raises(RowsDoNotMatch, match="block 0, step 0"),
    ):
        one_call(run, policy)
    assert not run.num_dropped


@pytest.mark.parametrize("where", ["weights", "input", "actions"])
def test_numbers_that_are_not_finite_are_refused(tmp_path, policy, where):
    inputs, origin = given(), "step 0, block 0"
    if where == "weights":
        with torch.no_grad():
            policy.state.weight.fill_(torch.inf)
    elif where == "input":
        inputs["states"] = torch.full((1, 2), torch.nan)
    else:
        origin = "actions"
    with (
        start(tmp_path, policy) as run,
        pytest.raises(NumbersNotFinite, match=rf"replan 0 \(environment step 3\) of task0.*{origin}"),
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
        episode.replan(env_step=3) as replan,
    ):
        replan.actions = policy.act(**inputs) * (torch.nan if where == "actions" else 1)


def test_a_camera_of_latents_without_a_grid_may_have_pictures(tmp_path, policy):
    (joint,) = small_layout().sites
    image, *others = joint.keys.spans
    site = replace(joint, keys=replace(joint.keys, spans=(replace(image, grid=None), *others)))
    picture = np.random.default_rng(0).integers(0, 256, (12, 20, 3), dtype=np.uint8)
    with start(tmp_path, policy, layout=small_layout(sites=(site,)), frames=True) as run:
        with pytest.raises(BadArgument):
            one_call(run, policy, masks={"front": np.zeros((12, 20), int)})
        one_call(run, policy, frames={"front": picture})
    np.testing.assert_array_equal(stored(tmp_path).episodes[0].read("frames/front")[0], picture)


@pytest.mark.parametrize("layout", [None, "small"])
def test_what_is_no_layout_is_refused(tmp_path, policy, layout):
    with pytest.raises(BadArgument):
        start(tmp_path, policy, layout=layout)
    with pytest.raises(BadArgument):
        check_layout(policy, lambda: policy.act(**given()), layout, {"span:state": lambda: policy.act(**given())})


def test_the_meta_device_has_no_numbers(tmp_path):
    with torch.device("meta"):
        policy = SmallPolicy()
        inputs = {
            name: value.to("meta") if isinstance(value, torch.Tensor) else value for name, value in given().items()
        }
        with start(tmp_path, policy) as run, pytest.raises(UnseenAttention):
            one_call(run, policy, inputs)


def test_the_class_of_modules_is_written_to_once_a_run(tmp_path, policy):
    """Python (3.13) looks attributes up more slowly in a class that was written to a thousand times."""
    plain, seen = nn.Module.__call__, set()
    with start(tmp_path, policy) as run:
        for number in range(2):
            with run.episode(task_id=0, episode_index=number, instruction="pick the bowl") as episode:
                for step in range(2):
                    with episode.replan(env_step=step):
                        seen.add(nn.Module.__call__)
                        policy.act(**given())
                    seen.add(nn.Module.__call__)
    assert len(seen) == 1
    assert plain not in seen
    assert nn.Module.__call__ is plain
