"""One capture run: fill a store with the episodes that the settings ask for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from vla_attention.capture.effects.conditions import refuse_both
from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.effects.measurement import EffectMeasurement, measurement_of
from vla_attention.capture.engine.call import Caller
from vla_attention.capture.engine.faults import EpisodesMissing, Faults, describe_missing
from vla_attention.capture.engine.loop import EpisodeLoop
from vla_attention.capture.engine.plan import announce, plan_recording, root_attributes
from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.simulators import Simulators, check_protocol, max_replans
from vla_attention.capture.engine.source import Committed, EpisodeJob
from vla_attention.capture.environments.base import EnvironmentSettings, Task, check_initial_state_index
from vla_attention.capture.environments.episode_protocol import WAIT_STEPS, EvaluationProtocol
from vla_attention.capture.environments.suites import list_tasks
from vla_attention.capture.interventions.prompts import check_synonyms
from vla_attention.capture.interventions.resolution import check_not_compiled, interventions_for
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.jobs.worker_log import plan_of, planned_episodes, read_logs
from vla_attention.capture.machine import POLICY_BATCH, describe_machine
from vla_attention.capture.policies.families import family_of_kind
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.policy import BatchPolicy, Policy, is_compiled, stored_picture_sizes
from vla_attention.capture.run.run_settings import RunSettings, default_num_envs, default_policy_batch
from vla_attention.capture.store.disk_estimate import estimate_disk
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import BadArgument, listing, plural
from vla_attention.schemas.stores.store_format import (
    PolicyIdentity,
    Protocol,
    RootAttributes,
)
from vla_attention.schemas.stores.verify import DamagedEpisodesLeft, find_damaged, what_to_do


def plan_protocol(settings: RunSettings, evaluation: EvaluationProtocol, policy: Policy) -> Protocol:
    """Return the protocol of a run: what the settings leave open is as in the published evaluation.

    The number of executed actions is the policy's own, unless the evaluation is another ecosystem's and has a number.
    """
    replan_steps = policy.default_replan_steps
    if evaluation != policy.default_protocol and evaluation.replan_steps is not None:
        replan_steps = evaluation.replan_steps
    suite = settings.suite
    published_steps = evaluation.max_steps.get(suite.name, suite.max_steps)
    return Protocol(
        suite=suite.name,
        seed=evaluation.default_seed if settings.seed is None else settings.seed,
        wait_steps=WAIT_STEPS,
        replan_steps=replan_steps if settings.replan_steps is None else settings.replan_steps,
        max_steps=published_steps if settings.max_steps is None else settings.max_steps,
        name=evaluation.name,
        image_size=evaluation.image_size,
    )


@dataclass(frozen=True)
class RunPlan:
    """What a run of some settings is with a policy, before its store is opened.

    tasks: of the suite. wanted: those of them that are run. note: a line to print if layer numbers were translated.
    effects: what measures the effects of calls, if the run does.
    """

    evaluation: EvaluationProtocol
    tasks: tuple[Task, ...]
    wanted: tuple[Task, ...]
    changes: RunChanges
    attributes: RootAttributes
    note: str | None
    effects: EffectMeasurement | None = None


def plan_run(settings: RunSettings, policy: Policy, machine: Mapping[str, str]) -> RunPlan:
    """Plan a run, and check the settings against the policy. machine: provenance of this process."""
    evaluation = settings.protocol or policy.default_protocol
    protocol = plan_protocol(settings, evaluation, policy)
    check_protocol(protocol, policy)
    noise = protocol.seed if settings.interventions.noise is None else settings.interventions.noise.seed
    recording, note = plan_recording(settings.recording, policy, noise)
    tasks = list_tasks(settings.suite)
    wanted = tasks if settings.task_ids is None else tuple(tasks[number] for number in settings.task_ids)
    changes = plan_changes(settings, policy, tasks)
    if recording.effects is not None:
        refuse_both(changes.interventions)
    attributes = root_attributes(
        policy.identity(), policy.sites, protocol, recording, machine, interventions=changes.interventions
    )
    families = [(task.task_id, task.instruction, task.task_family) for task in tasks]
    pictures = pictures_of(settings.recording.effects, policy, settings.suite.name)
    effects = measurement_of(recording.effects, policy, families, say, pictures)
    return RunPlan(evaluation, tasks, wanted, changes, attributes, note, effects)


def run_capture(
    settings: RunSettings, policy: Policy, device: str, termination: Termination | None = None
) -> list[Committed]:
    """Record every missing episode of the settings, and print how many; returns the episodes that this process added.

    Raises:
        Terminated: SIGTERM was received; the episode in progress was dropped.
        EpisodesMissing: episodes were dropped, each after a fault of its own; all others were recorded.
        DamagedEpisodesLeft: all missing episodes were recorded, but the store holds damaged ones, which stay.
    """
    results, damaged, faults = _record_missing(settings, policy, device, termination or Termination())
    missing = f", {len(faults.dropped)} missing" if faults.dropped else ""
    solved = sum(bool(result.outcome.success) for result in results)
    say(f"{plural(len(results), 'episode')} added, {solved} solved{missing}. Store: {settings.store}")
    left = find_damaged(settings.store, damaged, settings.output.verify) if damaged else []
    if left and faults.dropped:
        raise EpisodesMissing(f"{describe_missing(faults.dropped)} {what_to_do(settings.store, left)}")
    faults.raise_missing()
    if left:
        raise DamagedEpisodesLeft(what_to_do(settings.store, left))
    return results


def _record_missing(
    settings: RunSettings, policy: Policy, device: str, termination: Termination
) -> tuple[list[Committed], list[str], Faults]:
    """Record what is missing; also returns the names of damaged episodes of the store, and the faults of this run."""
    machine = describe_machine(device) | downloads_of(policy)
    run_plan = plan_run(settings, policy, machine)
    tasks, wanted, changes, attributes = run_plan.tasks, run_plan.wanted, run_plan.changes, run_plan.attributes
    for task in wanted:
        check_initial_state_index(task, settings.num_episodes - 1)
    largest_batch = _policy_batch(settings, policy, device)
    if run_plan.note:
        say(run_plan.note)
    environment_settings = EnvironmentSettings(run_plan.evaluation, settings.libero_assets)
    store = open_run(settings.store, attributes, settings.output.mode)
    done = store.committed()
    jobs = [
        EpisodeJob(task, episode, attributes.protocol.max_steps, f"task {task.task_id} episode {episode}")
        for task in sorted(wanted, key=lambda task: task.task_id)
        for episode in range(settings.num_episodes)
    ]
    todo = [job for job in jobs if (job.task.task_id, job.episode_index) not in done]
    names = {job.name for job in jobs}
    damaged = find_damaged(store.path, names, settings.output.verify) if done else []
    pictures = stored_picture_sizes(policy, attributes.protocol.image_size)
    bound = estimate_disk(attributes.recording, attributes.sites, pictures, max_replans(attributes.protocol), len(todo))
    announce(attributes, list(_lines_on_source(attributes)), bound, store.path, len(names), damaged)
    damaged_names = [fault.name for fault in damaged]
    expected = (*wanted, *(tasks[index] for index in settings.array_task_ids))
    plan = plan_of((task, episode) for task in expected for episode in range(settings.num_episodes))
    known = planned_episodes(read_logs(store.path))
    if not todo and all(known.get(task.task_id, set()) >= {*task.indices} for task in plan):
        return [], damaged_names, Faults()
    num_envs = min(settings.num_envs or default_num_envs(), len(todo))
    batch = num_envs if largest_batch is None else min(largest_batch, num_envs)
    if batch > 1:  # calls of a batch round differently, and which share one depends on the simulators' speed
        machine = {**machine, POLICY_BATCH: str(batch)}
    if num_envs > 1:
        batches = f" Policy calls in batches of at most {batch}; --policy-batch N changes it." if batch > 1 else ""
        say(f"Simulators: {num_envs} processes; --num-envs N changes it.{batches}")
    caller = Caller(policy, attributes.recording, changes, run_plan.effects)
    source = Simulators(
        settings.suite, environment_settings, store, caller, machine, termination.check, max(1, num_envs)
    )
    loop = EpisodeLoop(store, plan, termination, "step", source, batch)
    results = loop.record_all(todo)
    if (empty := changes.describe_empty()) is not None:
        say(empty)
    return results, damaged_names, loop.faults


def _policy_batch(settings: RunSettings, policy: Policy, device: str) -> int | None:
    """Return the largest batch of policy calls, None for the number of simulators.

    Raises:
        BadArgument: `--policy-batch` asks for more than 1, and policy or interventions need single calls.
    """
    asked, single = settings.policy_batch, None
    if not isinstance(policy, BatchPolicy):
        single = f": policies of the kind {policy.family} make one call"
    elif is_compiled(policy.identity()):
        single = " with --compile, whose calls are made one by one"
    elif settings.interventions.changes_attention:
        single = " with interventions on attention, whose calls are made one by one"
    if single is None:
        return default_policy_batch(device) if asked is None else asked
    if asked is not None and asked > 1:
        raise BadArgument(f"Cannot use --policy-batch {asked}{single}; leave it out.")
    return 1


def plan_changes(settings: RunSettings, policy: Policy, tasks: Sequence[Task]) -> RunChanges:
    """Return the run's interventions; what is known to be wrong with them is an error now, before the first episode."""
    instructions = {task.task_id: task.instruction for task in tasks}
    if settings.interventions.changes_attention:
        check_not_compiled(policy.identity())
    changes = RunChanges(interventions_for(settings.interventions, policy), instructions, settings.allow_empty)
    if changes.interventions.prompt is not None:
        check_synonyms(changes.interventions.prompt, instructions.values())
    changes.check_names(policy.sites)
    return changes


def _checkpoint_line(identity: PolicyIdentity) -> str:
    facts = identity.config
    precision = f", {facts['dtype']}" if "dtype" in facts else ""
    labels = {"normalisation": "normalisation", "prompt_format": "prompt"}
    details = [f"{label} {facts[name]}" for name, label in labels.items() if name in facts]
    details.append(f"cameras {listing(f'{camera.name} = {camera.source}' for camera in identity.cameras)}")
    return (
        f"Checkpoint: {identity.family} in format {identity.checkpoint_format}{precision}, configuration: "
        f"{facts['configuration']}; {', '.join(details)}."
    )


def _other_suite_line(identity: PolicyIdentity, suite: str) -> str:
    """A warning where a checkpoint whose suites are known runs in one of another kind; empty elsewhere."""
    known = family_of_kind(identity.family).trained_on.get(identity.checkpoint, ())
    kinds = {name.partition("_")[0] for name in known}
    if not known or suite.partition("_")[0] in kinds:
        return ""
    return (
        f"WARNING: {identity.checkpoint} was trained on {listing(known)}; its numbers in {suite} say nothing about it."
    )


def _lines_on_source(attributes: RootAttributes) -> Iterator[str]:
    """Lines on where the policy calls come from: the checkpoint, the protocol, and what is executed."""
    identity, protocol = attributes.policy, attributes.protocol
    if not identity.untrained:
        yield _checkpoint_line(identity)
    if line := _other_suite_line(identity, protocol.suite):
        yield line
    yield (
        f"Protocol: {protocol.name} (docs/protocol.md), seed {protocol.seed}, pictures of {protocol.image_size} "
        f"pixels, {protocol.wait_steps} waiting steps, at most {protocol.max_steps} steps after them."
    )
    yield f"A policy call gives {identity.action_horizon} actions, of which {protocol.replan_steps} are executed."
