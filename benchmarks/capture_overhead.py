"""What recording adds to a policy call, and what the usual way of getting attention costs.

Usage: OMP_NUM_THREADS=1 python benchmarks/capture_overhead.py [--size small mid] [--rounds 9] [--device cpu]
       [--dtype float32] [--clock processor] [--general] [--save]

The policies are pi0.5 with seeded random weights and the key axis of openpi's pi05_libero (3 cameras of 256 keys, 200
text slots, 10 actions; ten denoise steps; 18 blocks, 8 heads). small: the policy `untrained`, an expert of width 96.
mid: an expert of width 512. full: the sizes of pi05_libero (3.35 billion parameters, for a GPU).

A policy call is `act`, from prepared tensors to the robot's actions; recording it is `Caller.make`, from the plan of
the recording to arrays that the store writer takes. All kinds take turns within a round. The actions of every kind are
compared with the plain call's, and must be bit-equal.

The usual way stands beside it: eager attention that returns whole matrices (every query of the prefix pass and of the
denoise steps to every key, key heads repeated, softmax in float32), each moved with `.cpu().numpy()` as its layer is
done.

--general compares our recorder of these policies with that of `va.record`, which watches the same model as one that
nobody knows. Both see one product with the values: ours is made by pieces of the keys else.

--save writes the rows to benchmarks/rows/capture_overhead.json.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any
from unittest import mock

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

from measurement import Table, fix_threads, measured, ratios, take_turns, write_rows  # noqa: E402

KINDS: dict[str, dict[str, Any]] = {
    "first and last step": {"steps": (0, 9), "contributions": False},
    "first and last step, contributions": {"steps": (0, 9), "contributions": True},
    "all ten steps": {"steps": tuple(range(10)), "contributions": False},
    "all ten steps, contributions": {"steps": tuple(range(10)), "contributions": True},
}
USUAL = "the usual way: whole matrices, all steps"


def sizes(name: str) -> Any:
    from vla_attention.capture.policies.pi.config import GemmaConfig, PiConfig, SiglipConfig, find_config
    from vla_attention.capture.policies.pi.embedded import EMBEDDED_CONFIG

    if name == "small":
        return EMBEDDED_CONFIG
    if name == "full":
        return find_config("pi05_libero")
    gemma = GemmaConfig(width=512, depth=18, mlp_dim=2048, head_dim=128)
    siglip = SiglipConfig(width=256, depth=6, mlp_dim=1024, num_heads=4)
    return PiConfig(gemma, gemma, siglip, action_horizon=10, max_token_len=200, vocab_size=1024)


def make_policy(name: str, device: str = "cpu", dtype: str = "float32") -> Any:
    """Return a policy of a size with seeded random weights."""
    import torch
    from full_size_tokenizer import FullSizeTokenizer

    from vla_attention.capture.policies.pi import embedded
    from vla_attention.capture.policies.pi.model import PiModel, model_from_state
    from vla_attention.capture.policies.pi.policy import PiPolicy
    from vla_attention.capture.policies.pi.processing import openpi_processing
    from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER

    config = sizes(name)
    if name == "full":  # drawn where they are used: the structure of the rows is not measured
        with torch.device("meta"):
            model = PiModel(config, getattr(torch, dtype))
        model = model.to_empty(device=device)
        generator = torch.Generator(device).manual_seed(0)
        for parameter_name, parameter in model.named_parameters():
            if "vision_tower" in parameter_name and "norm" in parameter_name and parameter_name.endswith("weight"):
                parameter.data.fill_(1)
                continue
            spread = parameter[0].numel() ** -0.5 if parameter.dim() > 1 else 0.02
            parameter.data.normal_(0, spread, generator=generator)
    else:
        weights = embedded.random_weights(config, 0)
        model = model_from_state(config, weights, dtype=getattr(torch, dtype), device=device)
    small = embedded.embedded_policy()
    processing = openpi_processing(config, embedded.builtin_stats(), replan_steps=5)
    tokenizer = FullSizeTokenizer(EMBEDDED_TOKENIZER) if name == "full" else small.tokenizer
    return PiPolicy(model, tokenizer, processing, small.source)


def prepared_input(policy: Any) -> Any:
    """Return a policy's input: two random pictures, the third camera masked as in LIBERO, and an instruction."""
    import numpy as np

    from vla_attention.capture.environments.base import Observation

    random = np.random.default_rng(0)
    observation = Observation(
        images={camera.source: random.integers(0, 255, (256, 256, 3), dtype=np.uint8) for camera in policy.cameras},
        eef_pos=np.array([-0.1, 0.0, 0.9]),
        eef_quat=np.array([0.999, 0.02, 0.03, 0.01]),
        gripper_qpos=np.array([0.02, -0.02]),
    )
    return policy.prepare(observation, "pick up the red cube and place it on the plate")


def recording_of(policy: Any, steps: tuple[int, ...], contributions: bool) -> Any:
    """Return the recording of all layers and heads at some denoise steps."""
    from vla_attention.schemas.stores.store_format import Recording

    layers, heads = tuple(range(policy.num_layers)), tuple(range(policy.num_heads))
    return Recording(layers, layers, steps, heads, "mean", policy.num_action_queries, 10, contributions=contributions)


@contextmanager
def usual_way(kept: list[Any]) -> Iterator[None]:
    """Make the attention of the language model and the expert eager, and keep the whole matrix of every call."""
    import torch

    from vla_attention.capture.policies.pi import gemma
    from vla_attention.capture.recording.attention import MASKED_LOGIT

    def eager(query: Any, key: Any, value: Any, mask: Any, scale: float, **_: Any) -> Any:
        groups = query.shape[1] // key.shape[1]
        key, value = key.repeat_interleave(groups, dim=1), value.repeat_interleave(groups, dim=1)
        logits = torch.matmul(query, key.transpose(2, 3)) * scale
        if mask is not None:
            logits = logits.masked_fill(~mask[:, None], MASKED_LOGIT)
        matrices = torch.softmax(logits, dim=-1, dtype=torch.float32)
        kept.append(matrices.cpu().numpy())
        return torch.matmul(matrices.to(value.dtype), value)

    with mock.patch.object(gemma, "attend", eager), mock.patch.object(gemma, "attend_unseen", eager):
        yield


def record_call(policy: Any, given: Any, recording: Any) -> Any:
    """Make a call with the seed 0 and record it; returns its actions and rows."""
    from vla_attention.capture.engine.call import Caller, PolicyCall
    from vla_attention.capture.interventions.changed_inputs import CallContext

    (made,) = Caller(policy, recording).make([PolicyCall(given, 0, CallContext(0, 0, 0), 0, "the benchmark")])
    return made


def calls_of(policy: Any, synchronise: Callable[[], None] = lambda: None) -> dict[str, Callable[[], Any]]:
    """Return the kinds of calls, each of which returns the actions; `plain` is the first."""
    given = prepared_input(policy)

    def plain() -> Any:
        actions = policy.act(given, 0)
        synchronise()
        return actions

    def recorded(kind: str) -> Callable[[], Any]:
        recording = recording_of(policy, **KINDS[kind])

        def call() -> Any:
            actions = record_call(policy, given, recording).actions
            synchronise()
            return actions

        return call

    def usual() -> Any:
        kept: list[Any] = []
        with usual_way(kept):
            return policy.act(given, 0)

    return {"plain": plain, **{kind: recorded(kind) for kind in KINDS}, USUAL: usual}


def general_calls(policy: Any, folder: Path, stack: ExitStack) -> dict[str, Callable[[], Any]]:
    """Return `calls_of` without the usual way, and the same kinds made with `va.record`."""
    import vla_attention as va
    from vla_attention.capture.policies.pi import model

    stack.enter_context(mock.patch.object(model, "pieces_of_keys", return_value=None))
    calls, steps, given, (keys,) = calls_of(policy), count(), prepared_input(policy), policy.sites
    del calls[USUAL]
    roles: dict[Any, Any] = {"image": "image", "text": "instruction", "state": "state", "action": "action"}
    site = va.RecordedSite(keys, (0, policy.num_action_queries), {span.name: roles[span.kind] for span in keys.spans})
    expert = r"paligemma_with_expert\.gemma_expert\.model\.layers\.(?P<block>\d+)\.self_attn"
    layout = va.PolicyLayout(
        "pi", policy.family, (site,), (va.CallRule(expert, "joint"), va.CallRule(".*", None)),
        policy.num_layers, policy.num_heads, policy.num_denoise_steps,
    )  # fmt: skip

    def recorded(episode: Any) -> Any:
        with episode.replan(env_step=next(steps)):
            return policy.act(given, 0)

    for number, (kind, settings) in enumerate(KINDS.items()):
        chosen = {"denoise_steps": list(settings["steps"]), "contributions": settings["contributions"]}
        run = va.record(folder / f"{number}.zarr", policy.model, layout=layout, durable=False, **chosen)
        episode = stack.enter_context(run).episode(task_id=0, episode_index=0, instruction="")
        calls[f"va.record: {kind}"] = partial(recorded, stack.enter_context(episode))
        for _ in range(3):  # watched throughout
            calls[f"va.record: {kind}"]()
    return calls


def overhead_table(
    policy: Any, rounds: int, clock: Callable[[], float], note: str, calls: dict[str, Callable[[], Any]] | None = None
) -> Table:
    """Measure all kinds in turn. calls: those of `calls_of` unless given."""
    import numpy as np

    calls = calls or calls_of(policy)
    expected = calls["plain"]()
    for kind in calls.keys() - {USUAL}:
        if not np.array_equal(calls[kind](), expected):
            raise RuntimeError(f"Recording changed the actions: {kind}")
    seconds = take_turns(calls, rounds, clock=clock)
    rows = [
        {
            "call": kind,
            "ms": measured(values, 1000),
            "times": measured(ratios(values, seconds["plain"])),
        }
        for kind, values in seconds.items()
    ]
    return Table({"call": "call", "ms": "ms", "times": "times the plain call"}, rows, note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", nargs="+", choices=("small", "mid", "full"), default=["small", "mid"])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", default="float32")
    parser.add_argument("--clock", choices=("wall", "processor"), default="processor")
    parser.add_argument("--general", action="store_true", help="compare with the recorder of va.record")
    parser.add_argument("--save", action="store_true", help="write benchmarks/rows/capture_overhead.json")
    arguments = parser.parse_args()
    fix_threads(1)
    clock = time.perf_counter if arguments.clock == "wall" else time.process_time
    what = "seconds of the processor" if arguments.clock == "processor" else "wall seconds"
    tables = {}
    for size in arguments.size:
        policy = make_policy(size, arguments.device, arguments.dtype)
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            calls = general_calls(policy, Path(folder), stack) if arguments.general else None
            tables[size] = overhead_table(policy, arguments.rounds, clock, f"Counted are {what}.", calls)
        for row in tables[size].rows:
            ms, times = row["ms"], row["times"]
            print(
                f"{size:6} {row['call']:42} {ms.median:8.1f} ms  {times.median:6.3f} "
                f"({times.lowest:.3f}, {times.highest:.3f})",
                flush=True,
            )
    if arguments.save:
        print(write_rows("capture_overhead", tables))


if __name__ == "__main__":
    main()
