"""What is checked of every policy with a layout: by other means than the recorder's."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import vla_attention as va
from tests.kit.uniform_attention import check_uniform, zeroed_queries
from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.policy_modules import modules_of
from vla_attention.capture.torch_policies.watch import seen_by_python
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

#: Rows of the kernel's own logits in float32, computed twice.
ROW_TOLERANCE = 2e-6
#: Where the policy computes in float32.
PRODUCT_TOLERANCE = 1e-5


@dataclass
class PolicyCase:
    """A policy and how it is called.

    call: makes one policy call from an observation and returns the actions; the same numbers at every call.
    observation: what `call` takes. frames: camera -> picture (3, height, width) with numbers from 0 to 1.
    """

    policy: Any
    layout: PolicyLayout
    call: Callable[[Any], Tensor]
    observation: Any
    frames: Mapping[str, Tensor] = field(default_factory=dict)
    state: Tensor | None = None
    instruction: str = INSTRUCTION


def record(case: PolicyCase, path: Path, replans: int = 5, **settings: Any) -> Any:
    """Record one episode and return the opened store; checks that actions are bit-equal and that the store is whole.

    The first three replans are watched throughout, and the others only where attention ran: they have to give the same.
    """
    with seen_by_python():
        expected = case.call(case.observation)
    settings = {"tokenizer": WordTokenizer(), "bits": 23, "durable": False, "queries": "all", "layers": None} | settings
    settings.setdefault("denoise_steps", ["all"])
    with (
        va.record(path / "run.zarr", case.policy, layout=case.layout, untrained=True, **settings) as run,
        run.episode(task_id=0, episode_index=0, instruction=case.instruction, seed=7) as episode,
    ):
        for step in range(replans):
            with episode.replan(env_step=10 * step, frames=case.frames, state=case.state) as replan:
                actions = case.call(case.observation)
                replan.actions = actions[0]
            assert replan.recorded
            if "interventions" not in settings:
                torch.testing.assert_close(actions, expected, rtol=0, atol=0)
        episode.success = True
    store = open_store(path / "run.zarr")
    assert verify_store(store) == []
    if "interventions" not in settings:
        assert run.largest_error < PRODUCT_TOLERANCE
    assert store.attributes.recording.contributions == settings.get("contributions", True)
    for site in store.attributes.sites:
        rows = rows_of(store, site.name)
        np.testing.assert_array_equal(rows, np.broadcast_to(rows[:1], rows.shape))
        if store.attributes.recording.contributions:
            grams = store.episodes[0].read(f"{site.name}/contribution")
            most = np.abs(grams[:1]).max(axis=(-1, -2), keepdims=True).clip(1e-9)
            np.testing.assert_allclose(grams / most, np.broadcast_to(grams[:1] / most, grams.shape), atol=1e-5, rtol=0)
    return store


def check_inspect(case: PolicyCase, modules: Mapping[str, int]) -> None:
    """Check that `va.inspect` finds as many calls of modules as blocks times denoise steps, and that none is refused.

    modules: expression for the paths of a site's modules -> number of calls.
    """
    found = va.inspect(case.policy, lambda: case.call(case.observation))
    counts = {path: sum(re.search(path, call.module) is not None for call in found.calls) for path in modules}
    assert counts == modules
    assert not any(found.refused)
    assert max(found.errors) < PRODUCT_TOLERANCE


def rows_of(store: Any, site: str) -> np.ndarray:
    """Rows (replan, layer, denoise, head, query, key) of the first episode."""
    return np.asarray(store.episodes[0].read(f"{site}/rows"))


def roles_of(store: Any, site: str, replan: int = 0) -> list[str]:
    """Roles of a site's keys at one replan."""
    return [Role(int(code)).label for code in store.episodes[0].read(f"{site}/key_role")[replan]]


def check_rows(store: Any, site: str, expected: np.ndarray) -> None:
    """Compare the first replan's rows with rows (layer, denoise, head, query, key) that were computed by hand."""
    np.testing.assert_allclose(rows_of(store, site)[0], expected, atol=ROW_TOLERANCE, rtol=0)


def check_change(case: PolicyCase, keys: str, observation: Any, **settings: Any) -> None:
    """Check that another observation moves exactly these keys (grouping language), before any block has mixed them."""
    settings = {"tokenizer": WordTokenizer(), "instruction": case.instruction} | settings
    found = va.check_layout(
        case.policy,
        lambda: case.call(case.observation),
        case.layout,
        {keys: lambda: case.call(observation)},
        **settings,
    )
    assert found.fits, found


@contextmanager
def kept_outputs(modules: Sequence[Any], pick: Callable[[Any, tuple[Any, ...], Any], Any]) -> Any:
    """Collect `pick(module, inputs, output)` of every forward of the modules: a list for each module."""
    kept: list[list[Any]] = [[] for _ in modules]

    def hook_of(number: int) -> Any:
        return lambda module, inputs, output: kept[number].append(pick(module, inputs, output))

    handles = [module.register_forward_hook(hook_of(number)) for number, module in enumerate(modules)]
    try:
        yield kept
    finally:
        for handle in handles:
            handle.remove()


#: A module, and whether the residual stream is what it is given or what it returns.
Stream = tuple[Any, Literal["given", "returned"]]


def check_contributions(
    case: PolicyCase,
    store: Any,
    site: str,
    stream: Callable[[int], tuple[Stream, Stream]],
    projection: str = "",
) -> None:
    """Compare what is stored of each block of a site with what it adds to the residual stream in the policy's own call.

    stream: block -> where the residual stream is seen before the attention and behind it. projection: path of the
    output projection, with {block}, where it has a bias: no key gives that, and it is taken away.
    """
    recorded, modules = case.layout.site(site), modules_of(case.policy)
    blocks = recorded.keys.layers or tuple(range(case.layout.num_layers))
    places = [place for block in blocks for place in stream(block)]
    number = {"given": 0, "returned": 1}

    def numbers(_module: Any, inputs: tuple[Any, ...], output: Any) -> list[Tensor]:
        first = output[0] if isinstance(output, tuple) else output
        return [value.detach().clone() for value in (inputs[0], first)]

    with kept_outputs([module for module, _ in places], numbers) as kept:
        case.call(case.observation)
    # Before the denoise steps, the same modules may compute a prefix.
    last = 0 if case.layout.autoregressive else -case.layout.num_denoise_steps
    seen = [[call[number[which]] for call in calls[last:]] for calls, (_, which) in zip(kept, places, strict=True)]
    expected = []
    for block, before, after in zip(blocks, seen[::2], seen[1::2], strict=True):
        bias = modules[projection.replace("{block}", str(block))].bias if projection else None
        norms = []
        for first, second in zip(before, after, strict=True):
            added = (second - first)[:, 0] if case.layout.name == "act" else (second - first)[0]
            added = added[slice(*recorded.queries(len(added)))]
            added = added if bias is None else added - bias.detach()
            norms.append(float(added.square().sum(dim=-1).mean()))
        expected.append([np.mean(norms)] if case.layout.autoregressive else norms)
    assert store.attributes.recording.contributions
    grams = np.asarray(store.episodes[0].read(f"{site}/contribution"))
    least = 1e-6 * np.max(expected)
    assert least > 0
    for gram in grams:
        np.testing.assert_allclose(gram[..., -1, -1], expected, rtol=1e-3, atol=least)
        np.testing.assert_allclose(gram[..., :-1, :-1].sum(axis=(-1, -2)), expected, rtol=1e-3, atol=least)


def softmax_rows(query: Tensor, key: Tensor, scale: float, mask: Tensor | None = None) -> np.ndarray:
    """Rows (head, query, key) of (head, query, dim) and (head, key, dim) in float64; mask: True where a key is seen."""
    logits = query.double() @ key.double().transpose(-1, -2) * scale
    if mask is not None:
        logits = logits.masked_fill(~mask, float("-inf"))
    return torch.softmax(logits, dim=-1).detach().numpy()


def check_uniform_attention(case: PolicyCase, path: Path, **settings: Any) -> None:
    """Queries that are zero attend uniformly: every group with a key that some query sees has lift 1, at every site."""
    with zeroed_queries(case.policy):
        for queries in ("mean", "all"):
            record(case, path / queries, queries=queries, **settings)
            check_uniform(path / queries / "run.zarr")


def check_analysis(path: Path, sites: Sequence[str], *, ratios: bool = True) -> None:
    """Run the questions of the analysis that a store of one episode can answer, at every site."""
    run = va.open(path / "run.zarr")
    for site in sites:
        masses = run.analyze(site=site)["steps_groups"]
        assert masses.height > 0
        if ratios:
            assert run.analyze(site=site)["tasks"].height > 0


def check_total_effect(case: PolicyCase, path: Path, tokenizer: Any, word: str, by_hand: Tensor) -> None:
    """Compare the stored effect of a word, cut for all queries, with the actions of a call changed by hand.

    by_hand: (1, action, number).
    """
    with (
        va.record(
            path / "effects.zarr", case.policy, layout=case.layout, tokenizer=tokenizer, untrained=True, durable=False,
            effects=va.EffectSettings(("text",)),
        ) as run,
        run.episode(task_id=0, episode_index=0, instruction=case.instruction) as episode,
        episode.replan(env_step=0, repeat=lambda _call: case.call(case.observation)) as replan,
    ):  # fmt: skip
        replan.actions = plain = case.call(case.observation)
    stored = open_store(path / "effects.zarr").episodes[0]
    effects = stored.attributes.effects
    names = [effects.conditions[number].name for number in effects.condition]
    change = stored.read("effects/change")[names.index(f"without_word_{word}_queries_all")]
    expected = (by_hand - plain)[0].numpy()
    np.testing.assert_allclose(change, expected, atol=1e-6)
    assert np.abs(expected).max() > 1e-3


def check_cut(case: PolicyCase, path: Path, keys: str, by_hand: Tensor) -> None:
    """Compare the actions of a call whose action queries do not read some keys with those of one changed by hand.

    keys: in the grouping language. by_hand: (1, action, number).
    """
    with (
        va.record(
            path / "cut.zarr", case.policy, layout=case.layout, untrained=True, durable=False,
            interventions=va.knockout(keys),
        ) as run,
        run.episode(task_id=0, episode_index=0, instruction=case.instruction) as episode,
        episode.replan(env_step=0) as replan,
    ):  # fmt: skip
        replan.actions = changed = case.call(case.observation)
    torch.testing.assert_close(changed, by_hand, atol=1e-6, rtol=0)
    assert (changed - case.call(case.observation)).abs().max() > 1e-3
