"""One capture run: fill a store with the episodes that the settings ask for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from vla_attention.capture.effects.conditions import refuse_both
from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.effects.measurement import measurement_of
from vla_attention.capture.effects.prompt_tables import with_rows
from vla_attention.capture.engine.call import Caller
from vla_attention.capture.engine.faults import EpisodesMissing, Faults, describe_missing
from vla_attention.capture.engine.loop import EpisodeLoop
from vla_attention.capture.engine.plan import announce, plan_recording, root_attributes
from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.simulators import Simulators, check_protocol, max_replans
from vla_attention.capture.engine.source import Committed, EpisodeJob
from vla_attention.capture.environments.base import EnvironmentSettings, Task, check_initial_state_index
from vla_attention.capture.environments.episode_protocol import WAIT_STEPS, EvaluationProtocol
from vla_attention.capture.environments.suites import list_tasks, tasks_by_scene
from vla_attention.capture.interventions.prompts import check_synonyms
from vla_attention.capture.interventions.resolution import interventions_for
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.jobs.worker_log import plan_of, planned_episodes, read_logs
from vla_attention.capture.machine import POLICY_BATCH, describe_machine
from vla_attention.capture.policies.families import family_of_kind
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.policy import BatchPolicy, Policy, stored_picture_sizes
from vla_attention.capture.run.exchange import describe_exchange, exchanged_jobs
from vla_attention.capture.run.run_settings import RunSettings, default_num_envs
from vla_attention.capture.store.disk_estimate import estimate_disk
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import BadArgument, listing, plural
from vla_attention.schemas.libero_physics import MEND, is_libero, what_differs
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.stores.store_format import PolicyIdentity, Protocol
from vla_attention.schemas.stores.verify import DamagedEpisodesLeft, find_damaged, what_to_do


def plan_protocol(settings: RunSettings, evaluation: EvaluationProtocol, policy: Policy) -> Protocol:
    """Return the protocol of a run: what the settings leave open is as in the published evaluation.

    The number of executed actions is the policy's own, unless the evaluation is another ecosystem's and has a number.
    """
    replan_steps = policy.default_replan_steps
    if evaluation != policy.default_protocol and evaluation.replan_steps is not None:
        replan_steps = evaluation.replan_steps
    suite = settings.suite
    published_steps = evaluation.max_steps.get(suite.perturbs or suite.name, suite.max_steps)
    return Protocol(
        suite=suite.name,
        seed=evaluation.default_seed if settings.seed is None else settings.seed,
        wait_steps=WAIT_STEPS,
        replan_steps=replan_steps if settings.replan_steps is None else settings.replan_steps,
        max_steps=published_steps if settings.max_steps is None else settings.max_steps,
        name=evaluation.name,
        image_size=evaluation.image_size,
        exchanged=settings.most_rollouts is not None,
    )


def run_capture(
    settings: RunSettings, policy: Policy, device: str, termination: Termination | None = None
) -> list[Committed]:
    """Record every missing episode of the settings, and print how many; returns the episodes that this process added.

    Raises:
        Terminated: SIGTERM was received; the episode in progress was dropped.
        EpisodesMissing: episodes were dropped, each after a fault of its own; all others were recorded.
        DamagedEpisodesLeft: all missing episodes were recorded, but the store holds damaged ones, which stay.
    """
    machine, termination = describe_machine(device) | downloads_of(policy), termination or Termination()
    evaluation = settings.protocol or policy.default_protocol
    protocol = plan_protocol(settings, evaluation, policy)
    check_protocol(protocol, policy)
    tasks = list_tasks(settings.suite)
    wanted = tasks if settings.task_ids is None else tuple(tasks[number] for number in settings.task_ids)
    caller = _plan_calls(settings, policy, protocol, tasks)
    changes = caller.changes
    attributes = root_attributes(
        policy.identity(), policy.sites, protocol, caller.recording, machine, interventions=changes.interventions
    )
    for task in wanted:
        check_initial_state_index(task, settings.num_episodes - 1)
    environment = EnvironmentSettings(evaluation, settings.libero_assets)
    jobs, source_lines = _jobs(settings, wanted, environment, protocol.max_steps)
    num_envs = settings.num_envs or default_num_envs(settings.suite)
    batch = _policy_batch(settings, policy, device, num_envs)
    store = open_run(settings.store, attributes, settings.output.mode)
    done = store.committed()
    todo = [job for job in jobs if (job.task.task_id, job.episode_index) not in done]
    damaged = find_damaged(store.path, {job.name for job in jobs}, settings.output.verify) if done else []
    pictures = stored_picture_sizes(policy, protocol.image_size)
    bound = estimate_disk(caller.recording, policy.sites, pictures, max_replans(protocol), len(todo))
    lines = [*_lines_on_source(policy.identity(), protocol), *lines_on_physics(machine, protocol), *source_lines]
    announce(attributes, lines, bound, store.path, len(jobs), damaged)
    others = [(tasks[i], episode) for i in settings.array_task_ids for episode in range(settings.num_episodes)]
    plan = plan_of([*((job.task, job.episode_index) for job in jobs), *others])
    known = planned_episodes(read_logs(store.path))
    results, faults = [], Faults()
    if todo or not all(known.get(task.task_id, set()) >= {*task.indices} for task in plan):
        num_envs = min(num_envs, len(todo))
        batch = min(batch, num_envs)
        if batch > 1:  # calls of a batch round differently, and which share one depends on the simulators' speed
            machine[POLICY_BATCH] = str(batch)
        if num_envs > 1:
            batches = f" Policy calls in batches of at most {batch}; --policy-batch N changes it." if batch > 1 else ""
            say(f"Simulators: {num_envs} processes; --num-envs N changes it.{batches}")
        source = Simulators(settings.suite, environment, store, caller, machine, termination.check, max(1, num_envs))
        loop = EpisodeLoop(store, plan, termination, "step", source, batch)
        results, faults = loop.record_all(todo), loop.faults
        if (empty := changes.describe_empty()) is not None:
            say(empty)
    missing = f", {len(faults.dropped)} missing" if faults.dropped else ""
    solved = sum(bool(result.outcome.success) for result in results)
    say(f"{plural(len(results), 'episode')} added, {solved} solved{missing}. Store: {settings.store}")
    # Another process may have moved them aside in the meantime.
    left = find_damaged(settings.store, [one.name for one in damaged], settings.output.verify) if damaged else []
    lacking = [describe_missing(faults.dropped)] if faults.dropped else []
    lacking += [what_to_do(settings.store, left)] if left else []
    if lacking:
        raise (EpisodesMissing if faults.dropped else DamagedEpisodesLeft)(" ".join(lacking))
    return results


def _jobs(
    settings: RunSettings, wanted: Sequence[Task], environment: EnvironmentSettings, max_steps: int
) -> tuple[list[EpisodeJob], list[str]]:
    """Return the run's episodes, and what is printed of them."""
    states = settings.num_episodes
    if settings.most_rollouts is None:
        return [
            EpisodeJob(task, episode, max_steps, f"task {task.task_id} episode {episode}")
            for task in wanted
            for episode in range(states)
        ], []
    every = tasks_by_scene(settings.suite, environment)
    scenes = [chosen for scene in every if (chosen := [task for task in scene if task in wanted])]
    jobs = exchanged_jobs(settings.suite, scenes, states, max_steps, settings.most_rollouts)
    return jobs, [describe_exchange(scenes, states, jobs)]


def _plan_calls(settings: RunSettings, policy: Policy, protocol: Protocol, tasks: Sequence[Task]) -> Caller:
    """Return what makes the run's policy calls.

    What is known to be wrong with recording and interventions is an error now, before the first episode. tasks: of the
    suite.
    """
    asked, instructions = settings.interventions, {task.task_id: task.instruction for task in tasks}
    families = [(task.task_id, task.instruction, task.task_family) for task in tasks]
    planned = replace(settings.recording, effects=with_rows(settings.recording.effects, settings.suite.name, families))
    recording, note = plan_recording(planned, policy, asked.noise.seed if asked.noise else protocol.seed)
    changes = RunChanges(interventions_for(asked, policy), instructions, settings.allow_empty)
    if changes.interventions.prompt is not None:
        check_synonyms(changes.interventions.prompt, instructions.values())
    changes.check_names(policy.sites)
    if recording.effects is not None:
        refuse_both(changes.interventions)
    pictures = pictures_of(settings.recording.effects, policy, settings.suite.name)
    if note:
        say(note)
    effects = measurement_of(recording.effects, policy, families, say, pictures, protocol.replan_steps)
    return Caller(policy, recording, changes, effects, looks_at_words=True)


def _policy_batch(settings: RunSettings, policy: Policy, device: str, num_envs: int) -> int:
    """Return the largest batch of policy calls: without `--policy-batch` 1 on a processor, which does not gain by more.

    Raises:
        BadArgument: `--policy-batch` asks for more than 1, and policy or interventions need single calls.
    """
    asked, single = settings.policy_batch, ""
    if not isinstance(policy, BatchPolicy):
        single = f": policies of the kind {policy.family} make one call"
    elif "compiled" in policy.identity().config:
        single = " with --compile, whose graph is of one call"
    elif settings.interventions.changes_attention:
        single = " with interventions on attention, whose calls are made one by one"
    if single and asked is not None and asked > 1:
        raise BadArgument(f"Cannot use --policy-batch {asked}{single}; leave it out.")
    return asked or (1 if single or device.startswith("cpu") else num_envs)


def lines_on_physics(machine: Mapping[str, str], protocol: Protocol) -> list[str]:
    """Return a line where LIBERO's scenes will not be those of the published evaluations."""
    version = machine.get("mujoco", "")
    if not is_libero(protocol.suite) or not (differs := what_differs(version)):
        return []
    return [f"WARNING: with MuJoCo {version} {differs}; {MEND} mends it."]


def _lines_on_source(identity: PolicyIdentity, protocol: Protocol) -> list[str]:
    """Return lines on where the policy calls come from: the checkpoint, the protocol, and what is executed."""
    lines, facts = [], identity.config
    if not identity.untrained:
        precision = f", {facts['dtype']}" if "dtype" in facts else ""
        labels = {"normalisation": "normalisation", "prompt_format": "prompt"}
        details = [f"{label} {facts[name]}" for name, label in labels.items() if name in facts]
        details.append(f"cameras {listing(f'{camera.name} = {camera.source}' for camera in identity.cameras)}")
        lines.append(
            f"Checkpoint: {identity.family} in format {identity.checkpoint_format}{precision}, configuration: "
            f"{facts['configuration']}; {', '.join(details)}."
        )
    trained_on = family_of_kind(identity.family).trained_on.get(identity.checkpoint, ())
    if trained_on and protocol.suite.partition("_")[0] not in {name.partition("_")[0] for name in trained_on}:
        unlike = f"its numbers in {protocol.suite} say nothing about it."
        lines.append(f"WARNING: {identity.checkpoint} was trained on {listing(trained_on)}; {unlike}")
    return [
        *lines,
        f"Protocol: {protocol.name} (docs/my-checkpoint.md), seed {protocol.seed}, pictures of {protocol.image_size} "
        f"pixels, {protocol.wait_steps} waiting steps, at most {protocol.max_steps} steps after them.",
        f"A policy call gives {identity.action_horizon} actions, of which {protocol.replan_steps} are executed.",
    ]
