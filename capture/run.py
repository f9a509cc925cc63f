"""One capture run: from settings to a filled store, with progress and a summary."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from tqdm import tqdm

from capture.disk_estimate import describe, estimate_disk, format_bytes
from capture.environments.base import EnvironmentSettings, Task
from capture.environments.suites import Suite, check_initial_state_index, list_tasks, make_environment
from capture.machine import describe_machine
from capture.policies.base import Policy
from capture.policies.identity import identify
from capture.rollout import EpisodeResult, check_protocol, max_replans, run_episode
from capture.store_writer import RunStore, WriteMode, open_run
from schemas.errors import BadArgument, listing
from schemas.layers import select_layers
from schemas.store import FORMAT_NAME, FORMAT_VERSION, Protocol, Recording, RootAttributes

_QUERIES = {"mean": "the mean over", "steps": "the action steps' means over", "all": "each of"}


@dataclass(frozen=True)
class RecordingSettings:
    """What a user asks to be recorded; None and empty mean the default."""

    layers: tuple[int, ...] | None = None
    denoise_steps: tuple[str, ...] = ("first", "last")
    heads: tuple[int, ...] | None = None
    queries: str = "mean"
    mantissa_bits: int = 10
    frames: bool = True
    contributions: bool = True


@dataclass(frozen=True)
class RunSettings:
    """What a user asks to be run."""

    suite: Suite
    task_id: int | None
    num_episodes: int
    seed: int
    #: None: what the policy's own evaluation does
    replan_steps: int | None
    max_steps: int
    store: Path
    mode: WriteMode
    environment: EnvironmentSettings
    recording: RecordingSettings


def plan_recording(settings: RecordingSettings, policy: Policy) -> tuple[Recording, str | None]:
    """Check what is asked for against the policy; also returns the line to print when layer numbers were translated."""
    layers = select_layers(settings.layers, policy.num_layers, policy.provenance()["family"])
    steps = _denoise_steps(settings.denoise_steps, policy.num_denoise_steps)
    heads = tuple(range(policy.num_heads)) if settings.heads is None else settings.heads
    for head in heads:
        if not 0 <= head < policy.num_heads:
            raise BadArgument(f"There is no head {head}; expected 0 to {policy.num_heads - 1}.")
    if len(set(heads)) != len(heads):
        raise BadArgument(f"Heads {listing(heads)} name one of them twice.")
    if settings.queries not in ("mean", "steps", "all"):
        raise BadArgument(f"Cannot use --queries '{settings.queries}'; expected 'mean', 'steps' or 'all'.")
    recording = Recording(
        layers=tuple(sorted(set(layers.blocks))),
        layer_labels=tuple(sorted(layers.labels, key=lambda label: (label % policy.num_layers, label))),
        denoise_steps=steps,
        heads=tuple(sorted(heads)),
        queries=cast(Literal["mean", "steps", "all"], settings.queries),
        num_action_queries=policy.num_action_queries,
        num_pools=len(policy.query_pools()) if settings.queries == "steps" else 0,
        mantissa_bits=settings.mantissa_bits,
        frames=settings.frames,
        contributions=settings.contributions,
    )
    return recording, layers.note


def _denoise_steps(words: Sequence[str], count: int) -> tuple[int, ...]:
    named = {"first": (0,), "last": (count - 1,), "all": tuple(range(count))}
    steps: set[int] = set()
    for word in words:
        if word in named:
            steps.update(named[word])
        elif word.isdigit() and int(word) < count:
            steps.add(int(word))
        else:
            raise BadArgument(
                f"There is no denoise step '{word}'; expected numbers 0 to {count - 1}, 'first', 'last' or 'all'."
            )
    return tuple(sorted(steps))


def run_capture(settings: RunSettings, policy: Policy, device: str) -> list[EpisodeResult]:
    """Run every missing episode of the settings into the store; returns the episodes that were added."""
    protocol = Protocol(
        suite=settings.suite.name,
        seed=settings.seed,
        wait_steps=10,
        replan_steps=policy.default_replan_steps if settings.replan_steps is None else settings.replan_steps,
        max_steps=settings.max_steps,
    )
    check_protocol(protocol, policy)
    recording, note = plan_recording(settings.recording, policy)
    tasks = list_tasks(settings.suite, settings.environment)
    wanted = tasks if settings.task_id is None else (tasks[settings.task_id],)
    for task in wanted:
        check_initial_state_index(task, settings.num_episodes - 1)
    machine = describe_machine(device)
    identity = identify(policy)
    attributes = RootAttributes(
        format=FORMAT_NAME,
        format_version=FORMAT_VERSION,
        policy=identity,
        protocol=protocol,
        recording=recording,
        sites=policy.sites,
        provenance=machine,
    )
    if note:
        say(note)
    store = open_run(settings.store, attributes, settings.mode)
    done = store.committed()
    todo = [
        (task, episode)
        for episode in range(settings.num_episodes)
        for task in wanted
        if (task.task_id, episode) not in done
    ]
    todo.sort(key=lambda item: item[0].task_id)
    _announce(policy, store, len(wanted) * settings.num_episodes, len(todo))
    return _run_episodes(settings, policy, store, todo, machine) if todo else []


def _announce(policy: Policy, store: RunStore, num_wanted: int, num_todo: int) -> None:
    identity, recording, protocol = store.attributes.policy, store.attributes.recording, store.attributes.protocol
    say(
        f"Policy: {identity.name} ({identity.checkpoint_format}: {identity.checkpoint}), weights {identity.digest[:12]}."
    )
    if identity.untrained:
        say(
            "These weights are random and UNTRAINED: the numbers show that the tool works, and say nothing about any policy."
        )
    facts = identity.config
    if not identity.untrained:
        say(
            f"Checkpoint: {identity.family} in format {identity.checkpoint_format}, {facts['dtype']}, configuration: "
            f"{facts['configuration']}; normalisation {facts['normalisation']}, prompt {facts['prompt_format']}, "
            f"cameras {listing(f'{camera.name} = {camera.source}' for camera in identity.cameras)}."
        )
    say(f"A policy call gives {identity.action_horizon} actions, of which {protocol.replan_steps} are executed.")
    pictures = [np.prod((camera.grid.image_height, camera.grid.image_width, 3)).item() for camera in policy.cameras]
    say(
        f"Recording {len(recording.layers)} layers, denoise steps {listing(recording.denoise_steps)}, {len(recording.heads)} heads, "
        f"{_QUERIES[recording.queries]} {recording.num_action_queries} action queries, "
        f"{', '.join(str(site.num_keys) for site in store.attributes.sites)} keys."
    )
    estimate = estimate_disk(recording, store.attributes.sites, pictures, max_replans(protocol), num_todo)
    say(describe(estimate, store.path))
    if num_todo < num_wanted:
        say(f"{num_wanted - num_todo} of {num_wanted} episodes are complete already; {num_todo} to run.")


def _run_episodes(
    settings: RunSettings,
    policy: Policy,
    store: RunStore,
    todo: Sequence[tuple[Task, int]],
    machine: dict[str, str],
) -> list[EpisodeResult]:
    results: list[EpisodeResult] = []
    terminal = sys.stderr.isatty()
    bar = tqdm(total=len(todo) * store.attributes.protocol.max_steps, unit="step", disable=not terminal)
    environment, current = None, None
    try:
        for number, (task, episode) in enumerate(todo, start=1):
            if current != task.task_id:
                if environment is not None:
                    environment.close()
                environment, current = (
                    make_environment(settings.suite, task.task_id, settings.environment),
                    task.task_id,
                )
            assert environment is not None
            bar.set_description(f"task {task.task_id} episode {episode}")
            begun, steps_before = time.monotonic(), bar.n

            def report(step: int, _most: int, before: float = steps_before) -> None:
                bar.update(before + step - bar.n)

            result = run_episode(environment, policy, store, task, episode, machine, report)
            bar.update(steps_before + store.attributes.protocol.max_steps - bar.n)
            results.append(result)
            size = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
            line = (
                f"[{number}/{len(todo)}] task {task.task_id} episode {episode}: "
                f"{'success' if result.success else 'no success'} after {result.num_steps} steps, {result.num_replans} replans, "
                f"{format_bytes(size)}, {time.monotonic() - begun:.0f} s ({task.instruction})"
            )
            bar.write(line) if terminal else say(line)
    finally:
        bar.close()
        if environment is not None:
            environment.close()
    return results


def say(line: str) -> None:
    """Print one line at once, also when the output is a file that somebody follows."""
    print(line, flush=True)
