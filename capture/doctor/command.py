"""`vla-attention capture doctor`: a line for everything that the described run needs, and `--accept`."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.doctor.acceptance import find_published_rate, judge, share_of_tasks
from vla_attention.capture.doctor.machine import (
    Finding,
    checked,
    find_drawing,
    find_gpu,
    find_memory,
    find_precision,
    find_processor,
    find_simulator,
    something_missing,
)
from vla_attention.capture.environments.drawing import check_simulator
from vla_attention.capture.environments.suites import find_suite
from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.engine.plan import RecordingSettings
from vla_attention.capture.run.run_settings import RunSettings, run_settings
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import INSTALL_CAPTURE, BadArgument, UserError, plural
from vla_attention.schemas.safe_text import print_line
from vla_attention.schemas.stores.store_place import check_writable, room_at
from vla_attention.schemas.threads import use_threads

if TYPE_CHECKING:
    from vla_attention.capture.budget.trial import Trial
    from vla_attention.capture.policies.policy import Policy
    from vla_attention.schemas.stores.store_format import Recording, RootAttributes


def run_doctor(arguments: argparse.Namespace, termination: Termination) -> int:
    """Run `vla-attention capture doctor` on parsed arguments.

    Returns 1 when something that the described run needs is missing, or `--accept` does not accept; otherwise 0.
    """
    if arguments.accept is not None:
        return _accept(arguments, termination)
    if arguments.published_rate is not None:
        raise BadArgument("Cannot use --published-rate without --accept CHECKPOINT.")
    if arguments.task_suite is None:
        arguments.task_suite = arguments.family.default_suite
    if arguments.num_episodes is None:
        arguments.num_episodes = arguments.episodes_of_a_run
    settings = run_settings(arguments)
    findings = []
    for finding in _findings(arguments, settings, termination):
        findings.append(finding)
        print_line(finding.describe())
    if something_missing(findings):
        missing = ", ".join(finding.what for finding in findings if finding.status == "missing")
        print(f"\nThe run cannot be made as described: {missing}.")
        return 1
    print("\nNothing is missing for the run.")
    return 0


def _findings(arguments: argparse.Namespace, settings: RunSettings, termination: Termination) -> Iterator[Finding]:
    threads = use_threads(arguments.threads)
    yield find_processor(threads)
    try:
        import torch

        from vla_attention.capture.machine.device import load_torch
    except ImportError as error:
        yield Finding("torch", "missing", f"torch cannot be loaded ({error}).", f"Install it: {INSTALL_CAPTURE}.")
        return
    yield find_memory()
    gpu = find_gpu(arguments.device, torch)
    yield gpu
    simulator = find_simulator(settings.suite, settings.libero_assets)
    yield from simulator
    drawing = Finding("drawing", "note", "Not tried before what is missing is there.")
    if not something_missing(simulator):
        drawing = find_drawing(settings.suite, settings.libero_assets)
    yield drawing
    store = _find_place(settings)
    yield store
    if gpu.status == "missing":
        return  # the policy cannot be loaded there
    device = load_torch(arguments.device, threads.number)
    if arguments.no_trial:
        yield _look_for_checkpoint(arguments)
        return
    policy, checkpoint = _load(arguments, device)
    yield checkpoint
    if policy is None:
        return
    identity = policy.identity()
    yield find_precision(str(identity.config.get("dtype", "")), device, torch)
    if something_missing([drawing, *simulator, store]):
        yield Finding("trial", "note", "Time and size are not measured before what is missing is there.")
        return
    yield from _try(settings, policy, device, termination)


def _look_for_checkpoint(arguments: argparse.Namespace) -> Finding:
    """Return where the checkpoint is, or which of its files are missing, without loading it."""
    name, path = arguments.checkpoint, Path(arguments.checkpoint).expanduser()
    try:
        arguments.family.check_files(arguments)
    except UserError as error:
        return Finding("checkpoint", "missing", str(error))
    not_loaded = "It is not loaded, nor are time and size measured (--no-trial)."
    if path.exists():
        size = format_bytes(_bytes_below(path))
        return Finding("checkpoint", "note", f"{name}, {size} of files. {not_loaded}")
    if name in arguments.family.built_in:
        return Finding("checkpoint", "note", f"{name} comes with the program. {not_loaded}")
    text = f"{name} is no folder here: a run looks for it in the caches of the hub and of openpi, then downloads it."
    return Finding("checkpoint", "note", f"{text} {not_loaded}")


def _bytes_below(path: Path) -> int:
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)


def _load(arguments: argparse.Namespace, device: str) -> tuple[Policy | None, Finding]:
    """Load the policy of the described run; None, and why, where that is impossible."""
    import torch

    loaded: list[Policy] = []

    def load() -> str:
        loaded.append(arguments.family.build(arguments, device))
        identity = loaded[0].identity()
        size = sum(tensor.nbytes for tensor in loaded[0].model.state_dict().values())
        facts = ", ".join([identity.family, identity.checkpoint_format, f"{format_bytes(size)} of weights"])
        return f"{identity.name} ({facts}), {'random weights' if identity.untrained else 'trained'}."

    try:
        finding = checked("checkpoint", load)
    except (MemoryError, torch.OutOfMemoryError) as error:
        line = str(error).splitlines()[0] if str(error) else "not enough memory"
        to_do = "Use a machine with more memory, or --dtype bfloat16."
        finding = Finding("checkpoint", "missing", f"{arguments.checkpoint} does not fit ({line}).", to_do)
    return (loaded[0] if finding.status == "ok" else None), finding


def _find_place(settings: RunSettings) -> Finding:
    """Return whether the store can be written where the run would write it, and the room there."""

    def look() -> str:
        from vla_attention.capture.store.store_root import read_existing_root
        from vla_attention.schemas.stores.root import episode_folders

        if settings.store.exists():
            read_existing_root(settings.store)
            held.append(len(episode_folders(settings.store)))
        check_writable(settings.store.parent, "--output")
        return f"{room_at(settings.store).describe()} free for {settings.store}."

    held: list[int] = []
    finding = checked("store", look)
    if finding.status == "ok" and any(held) and settings.mode == "new":
        to_do = "A run there needs --resume, which adds what is missing, or --overwrite, which begins again."
        return Finding("store", "note", f"{settings.store} holds {plural(held[0], 'episode')} already.", to_do)
    return finding


@dataclass(frozen=True)
class _PlannedRun:
    attributes: RootAttributes
    num_tasks: int
    trials: Sequence[Trial]


def _try(settings: RunSettings, policy: Policy, device: str, termination: Termination) -> Iterator[Finding]:
    """Run the first replans of a task, or with a budget of as many as the run; yield time and size of that run."""
    from vla_attention.capture.budget.budget import choose_recording, recordings_by_size
    from vla_attention.capture.rollout.episode import max_replans
    from vla_attention.capture.store.disk_estimate import mean_size

    try:
        planned = _plan(settings, policy, device, termination)
    except UserError as error:
        yield Finding("trial", "missing", str(error))
        return
    trials, attributes = planned.trials, planned.attributes
    protocol, episodes = attributes.protocol, planned.num_tasks * settings.num_episodes
    replans = max_replans(protocol)
    yield _time(settings, trials[0], replans, protocol.replan_steps, episodes)
    yield _memory_taken(device)
    candidates: tuple[Recording, ...] = (attributes.recording,)
    if settings.budget is not None:
        candidates = recordings_by_size(attributes.recording, policy.num_denoise_steps, settings.fixed)
    try:
        budget = settings.budget if settings.budget is not None else 1 << 62
        choice = choose_recording(
            candidates,
            budget,
            lambda recording: mean_size([trial.sample.size(recording) for trial in trials]).estimate(replans, episodes),
            policy.num_denoise_steps,
        )
    except UserError as error:
        yield Finding("size", "missing", str(error))
        return
    estimate, room = choice.estimate, room_at(settings.store)
    text = (
        f"At most {format_bytes(estimate.total_bytes)}: {episodes} episodes, up to {replans} replans each, "
        f"{format_bytes(estimate.bytes_per_replan)} a replan and {format_bytes(estimate.episode_overhead)} an episode, "
        f"with {estimate.inodes_per_episode} files and folders each ({estimate.total_inodes:,}); "
        f"measured on {sum(len(trial.sample.records) for trial in trials)} replans of "
        f"{'one task' if len(trials) == 1 else f'{len(trials)} tasks'}."
    )
    if settings.budget is not None:
        text = " ".join([text, *choice.lines])
    if estimate.exceeds(room):
        to_do = f"{room.describe()} are free: give --budget, fewer episodes, or another --output."
        yield Finding("size", "missing", text, to_do)
    else:
        yield Finding("size", "ok", text)


def _plan(settings: RunSettings, policy: Policy, device: str, termination: Termination) -> _PlannedRun:
    """Plan the run as `run_capture` does, check that it can continue its store, and try its first replans."""
    from vla_attention.capture.budget.budget import recordings_by_size
    from vla_attention.capture.budget.budgeted_recording import TRIED_TASKS
    from vla_attention.capture.budget.trial import run_trial, spread
    from vla_attention.capture.environments.base import EnvironmentSettings
    from vla_attention.capture.machine.provenance import describe_machine
    from vla_attention.capture.run.capture_run import plan_run
    from vla_attention.capture.store.store_root import check_same_run, read_existing_root

    plan = plan_run(settings, policy, describe_machine(device))
    attributes = plan.attributes
    candidates: tuple[Recording, ...] = (attributes.recording,)
    if settings.budget is not None:
        candidates = recordings_by_size(attributes.recording, policy.num_denoise_steps, settings.fixed)
    tried = replace(attributes, recording=candidates[0])
    if settings.mode == "resume" and settings.store.exists():
        existing = read_existing_root(settings.store)
        same = existing.recording if existing.recording in candidates else attributes.recording
        check_same_run(settings.store, existing, replace(attributes, recording=same))
    environment = EnvironmentSettings(plan.evaluation, settings.libero_assets)
    trials = [
        run_trial(policy, tried, task, environment, plan.changes, termination.check, effects=plan.effects)
        for task in spread(plan.wanted, TRIED_TASKS if settings.budget is not None else 1)
    ]
    return _PlannedRun(attributes, len(plan.wanted), trials)


def _time(settings: RunSettings, trial: Trial, replans: int, replan_steps: int, episodes: int) -> Finding:
    from vla_attention.capture.run.run_settings import default_num_envs

    num_envs = min(settings.num_envs or default_num_envs(), episodes)
    seconds = trial.seconds_of(replans, replan_steps, num_envs) * episodes
    simulators = f"{num_envs} simulators" if num_envs > 1 else "one simulator"
    return Finding(
        "time",
        "ok",
        f"At most {_duration(seconds)}, with {simulators}, if every episode runs to its last step: a policy call takes "
        f"{trial.policy_seconds:.2g} s, a step {trial.step_seconds:.2g} s, the start of an episode "
        f"{trial.start_seconds:.2g} s.",
    )


def _memory_taken(device: str) -> Finding:
    """Return what this process has taken, loading and calling the policy; simulators of their own take more."""
    import torch

    text = f"The policy's process took up to {format_bytes(_peak_bytes())}"
    if device.startswith("cuda"):
        text += f", and {format_bytes(torch.cuda.max_memory_reserved(device))} of the GPU's memory"
    return Finding(
        "memory", "ok", f"{text}. Each simulator in a process of its own takes more: 0.7 GB in cubes, 1.8 GB in LIBERO."
    )


def _peak_bytes() -> int:
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # kilobytes, except on macOS


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _accept(arguments: argparse.Namespace, termination: Termination) -> int:
    """Run ten episodes of the checkpoint, and print how its success stands to the published rate."""
    if arguments.task_id is not None or arguments.no_trial or arguments.budget is not None or arguments.resume:
        raise BadArgument("Cannot use --task-id, --budget, --resume or --no-trial with --accept: it runs ten episodes.")
    if not read_interventions(arguments).is_none:
        raise BadArgument("Cannot use interventions with --accept: the published rate is of the policy as it is.")
    published = find_published_rate(arguments.accept, arguments.task_suite, arguments.family, arguments.published_rate)
    arguments.checkpoint, arguments.task_suite = arguments.accept, published.suite
    threads = use_threads(arguments.threads)
    tasks, episodes = share_of_tasks(find_suite(arguments.task_suite).num_tasks)
    if arguments.num_episodes is None:
        arguments.num_episodes = episodes
    settings = run_settings(arguments)
    check_simulator(settings.suite, settings.libero_assets)

    from vla_attention.capture.budget.trial import spread
    from vla_attention.capture.machine.device import load_torch
    from vla_attention.capture.run.capture_run import run_capture

    chosen = spread(range(settings.suite.num_tasks), tasks)
    device = load_torch(arguments.device, threads.number)
    policy = arguments.family.build(arguments, device)
    with ExitStack() as stack:
        settings = replace(settings, task_ids=tuple(chosen))
        if arguments.store is None:
            # Success is all that is asked: the least is recorded, and nothing of it is kept.
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vla-accept-")))
            least = RecordingSettings(
                layers=(policy.num_layers - 1,), denoise_steps=("last",), frames=False, contributions=False
            )
            settings = replace(settings, store=folder / settings.store.name, mode="new", recording=least)
        results = run_capture(settings, policy, device, termination)
    failed = [f"task {result.task_id} episode {result.episode_index}" for result in results if not result.success]
    verdict = judge(len(results) - len(failed), len(results), published, failed)
    print()
    for line in verdict.lines:
        print(line)
    return 0 if verdict.accepted else 1
