"""Seconds of a policy call as it is, watched, and recorded: what `va.record` costs.

Usage: python benchmarks/recorder_overhead.py [--rounds 7] [--calls 1] [--blocks 6] [--width 1024] [--device cpu]
       [--dtype float32] [--threads 1] [--clock processor] [--replans 2000]

The policy is made for this: ten denoise steps of an action expert over a prefix of 968 keys of pictures and words and
over its own ten tokens, with the sizes of pi0's expert (width 1024, 8 heads of 256, one key head; 18 blocks in pi0) and
random weights. The pass over the prefix, which a real call makes too without any recording, is left out.
The kinds of call take turns within one round, so that all of them see the same machine; what is printed are the medians
of the rounds, and the median of their ratios to the plain call of the same round. `--clock processor` counts the
processor's time, which work of others on the machine does not change.

plain: without recording, eager, the fast path of nn.MultiheadAttention off. watched: inside of a replan block that
keeps the least that can be recorded (one head of one block at one denoise step). The others record all layers and
heads: of the last denoise step of ten, of the first and the last (the default), of all ten; and with contributions.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

import measurement  # noqa: E402 - scripts, and not part of the package

import vla_attention as va  # noqa: E402

HEADS, STEPS, HORIZON = 8, 10, 10
PATCHES, WORDS, CAMERAS = 256, 200, 3
PREFIX = CAMERAS * PATCHES + WORDS


class Attention(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.dim = width // 4
        self.q_proj = nn.Linear(width, HEADS * self.dim, bias=False)
        self.kv_proj = nn.Linear(width, 2 * self.dim, bias=False)
        self.o_proj = nn.Linear(HEADS * self.dim, width, bias=False)

    def forward(self, tokens: Tensor, cache: tuple[Tensor, Tensor], mask: Tensor) -> Tensor:
        query = self.q_proj(tokens).view(1, -1, HEADS, self.dim).transpose(1, 2)
        key, value = (part[:, None] for part in self.kv_proj(tokens).chunk(2, dim=-1))
        key, value = torch.cat([cache[0], key], dim=2), torch.cat([cache[1], value], dim=2)
        mixed = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=mask, enable_gqa=True)
        return self.o_proj(mixed.transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.attention = Attention(width)
        self.norms = nn.ModuleList(nn.RMSNorm(width) for _ in range(2))
        self.up, self.down = nn.Linear(width, 4 * width, bias=False), nn.Linear(4 * width, width, bias=False)

    def forward(self, tokens: Tensor, cache: tuple[Tensor, Tensor], mask: Tensor) -> Tensor:
        tokens = tokens + self.attention(self.norms[0](tokens), cache, mask)
        return tokens + self.down(nn.functional.gelu(self.up(self.norms[1](tokens))))


class Policy(nn.Module):
    """The denoise steps of a flow policy; the prefix's keys and values are random."""

    def __init__(self, blocks: int, width: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width) for _ in range(blocks))
        self.action_in, self.action_out = nn.Linear(32, width), nn.Linear(width, 32)

    @torch.no_grad()
    def act(self, noise: Tensor, caches: list[tuple[Tensor, Tensor]], mask: Tensor) -> Tensor:
        actions = noise
        for _ in range(STEPS):
            hidden = self.action_in(actions)
            for block, cache in zip(self.blocks, caches, strict=True):
                hidden = block(hidden, cache, mask)
            actions = actions - self.action_out(hidden) / STEPS
        return actions


def layout(blocks: int) -> va.PolicyLayout:
    spans = [
        va.Span(f"image_{i}", "image", i * PATCHES, (i + 1) * PATCHES, f"camera_{i}", va.PatchGrid(16, 16, 224, 224))
        for i in range(CAMERAS)
    ]
    spans.append(va.Span("prompt", "text", PREFIX - WORDS, PREFIX))
    spans.append(va.Span("actions", "action", PREFIX, PREFIX + HORIZON))
    roles = {span.name: {"image": "image", "text": "instruction", "action": "action"}[span.kind] for span in spans}
    keys = va.SiteLayout("joint", tuple(spans))
    return va.PolicyLayout(
        name="overhead",
        family="overhead",
        sites=(va.RecordedSite(keys, (0, HORIZON), roles),),
        rules=(va.CallRule(r"blocks\.(?P<block>\d+)\.attention", "joint"),),
        num_layers=blocks,
        num_heads=HEADS,
        num_denoise_steps=STEPS,
    )


KINDS: dict[str, dict[str, Any]] = {
    "watched": {"denoise_steps": [0], "layers": [0], "heads": [0], "contributions": False},
    "last step": {"denoise_steps": ["last"], "contributions": False},
    "first and last step": {"contributions": False},
    "all ten steps": {"denoise_steps": "all", "contributions": False},
    "last step, contributions": {"denoise_steps": ["last"], "contributions": True},
    "first and last step, contributions": {"contributions": True},
    "all ten steps, contributions": {"denoise_steps": "all", "contributions": True},
    "last step, knockout": {
        "denoise_steps": ["last"],
        "contributions": False,
        "interventions": va.knockout("camera:camera_0"),
    },
}


def measure(
    policy: nn.Module,
    layout: va.PolicyLayout,
    act: Callable[[], Tensor],
    kinds: Mapping[str, Mapping[str, Any]],
    folder: Path,
    rounds: int,
    calls: int,
    clock: Callable[[], float],
) -> dict[str, list[float]]:
    """Seconds of a call by kind, one number per round: the mean of `calls` calls.

    act: makes one call of the policy. kinds: what `va.record` is given, by kind; `plain` is the call without it.
    """

    def recorded(episode: Any, kind: str) -> None:
        with episode.replan(env_step=next(steps)):
            actions = act()
        assert "interventions" in kinds[kind] or torch.equal(actions, expected), kind

    def waited_for(call: Callable[[], object]) -> Callable[[], object]:
        def waiting() -> None:
            call()
            if torch.cuda.is_available():
                torch.cuda.synchronize()

        return waiting

    steps = itertools.count()
    with ExitStack() as stack:
        turns: dict[str, Callable[[], object]] = {"plain": act}
        for number, (kind, settings) in enumerate(kinds.items()):
            run = va.record(folder / f"{number}.zarr", policy, layout=layout, durable=False, **settings)
            stack.enter_context(run)
            episode = stack.enter_context(run.episode(task_id=0, episode_index=0, instruction=""))
            turns[kind] = functools.partial(recorded, episode, kind)
        expected = act()
        calls_of = {kind: waited_for(call) for kind, call in turns.items()}
        return measurement.take_turns(calls_of, rounds, repeats=calls, clock=clock)


def print_memory(policy: nn.Module, layout: va.PolicyLayout, act: Callable[[], Tensor], replans: int) -> None:
    """Print this process's memory in an episode of so many replans: the rows of all queries and denoise steps."""
    page, shown = resource.getpagesize(), {1, 10, *range(0, replans + 1, max(1, replans // 8))}
    frames = {f"camera_{i}": torch.zeros(3, 224, 224) for i in range(CAMERAS)}
    settings: dict[str, Any] = {"denoise_steps": "all", "queries": "all", "durable": False}
    print("| replans | memory, MB | store, MB |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        with (
            va.record(Path(folder) / "a.zarr", policy, layout=layout, **settings) as run,
            run.episode(task_id=0, episode_index=0, instruction="") as episode,
        ):
            for number in range(1, replans + 1):
                with episode.replan(env_step=number, frames=frames) as replan:
                    replan.actions = act()[0]
                if number in shown:
                    pages = int(Path("/proc/self/statm").read_text().split()[1])
                    size = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())
                    print(f"| {number:,} | {pages * page / 1e6:.0f} | {size / 1e6:,.0f} |", flush=True)
        print(
            f"| most, with the end of the episode | {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} | |"
        )


def milliseconds(seconds: list[float]) -> str:
    """The median of the rounds."""
    return f"{measurement.measured(seconds, factor=1000).median:.1f}"


def times(seconds: list[float], plain: list[float]) -> str:
    """The median, lowest and highest of the ratios within the rounds."""
    found = measurement.measured(measurement.ratios(seconds, plain))
    return f"{found.median:.3f} ({found.lowest:.3f}, {found.highest:.3f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--calls", type=int, default=1)
    parser.add_argument("--blocks", type=int, default=6)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", default="float32")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--clock", choices=("wall", "processor"), default="wall")
    parser.add_argument("--replans", type=int, help="print the memory in an episode of so many replans, and no times")
    arguments = parser.parse_args()
    clock = time.perf_counter if arguments.clock == "wall" else time.process_time
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    torch.backends.mha.set_fastpath_enabled(False)
    torch.manual_seed(0)
    settings: dict[str, Any] = {"device": arguments.device, "dtype": getattr(torch, arguments.dtype)}
    policy = Policy(arguments.blocks, arguments.width).to(**settings).eval()
    caches = [
        tuple(torch.randn(1, 1, PREFIX, arguments.width // 4, **settings) for _ in range(2))
        for _ in range(arguments.blocks)
    ]
    mask = torch.ones(1, 1, HORIZON, PREFIX + HORIZON, dtype=torch.bool, device=arguments.device)
    mask[..., PREFIX - 50 : PREFIX] = False
    given = torch.randn(1, HORIZON, 32, **settings), caches, mask
    if arguments.replans:
        print_memory(policy, layout(arguments.blocks), lambda: policy.act(*given), arguments.replans)
        return
    with tempfile.TemporaryDirectory() as folder:
        seconds = measure(
            policy,
            layout(arguments.blocks),
            lambda: policy.act(*given),
            KINDS,
            Path(folder),
            arguments.rounds,
            arguments.calls,
            clock,
        )
    machine = f"{arguments.device}, {arguments.dtype}, {torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {machine}, {arguments.clock} time")
    print("| call | ms, median of the rounds | times the plain call, median (lowest, highest) |\n|---|---|---|")
    for kind, values in seconds.items():
        print(f"| {kind} | {milliseconds(values)} | {times(values, seconds['plain'])} |")


if __name__ == "__main__":
    main()
