"""A replay with any torch policy, recorded by `va.record`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from msgspec import structs

from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.settings import recording_settings
from vla_attention.capture.engine.source import Committed, Episode, EpisodeJob, Outcome, Source
from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.policies.noise import noise_seed
from vla_attention.capture.policies.robot import NONE, RobotData
from vla_attention.capture.replay.policy_file import ReplayPolicy
from vla_attention.capture.replay.replay_plan import (
    ReplayPlan,
    announce_replay,
    columns_of,
    joined,
    record_episodes,
    success_of,
)
from vla_attention.capture.torch_policies.record import record
from vla_attention.capture.torch_policies.session import RecordedRun
from vla_attention.schemas.data_sets.lerobot_dataset import DataSetEpisode
from vla_attention.schemas.data_sets.video import decoder_version
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.layout import picture_size
from vla_attention.schemas.stores.root import read_run
from vla_attention.schemas.stores.store_format import RootAttributes


@dataclass
class FramesForFile(Source):
    """The frames of a data set's episodes, for the policy of a file, whose calls `va.record` records.

    cameras: camera of the layout -> column. state, actions: columns.
    """

    given: ReplayPolicy
    run: RecordedRun
    plan: ReplayPlan
    every: int
    seed: int
    cameras: dict[str, str]
    state: tuple[str, ...]
    actions: tuple[str, ...]
    caller: None = None

    def open(self, job: EpisodeJob) -> RecordedByRun:
        """Open an episode."""
        episode = self.plan.data.episode(job.episode_index)
        return RecordedByRun(Outcome(success_of(episode), episode.length), self._calls(job, episode))

    def _calls(self, job: EpisodeJob, episode: DataSetEpisode) -> Generator[None, None, Path]:
        """Make a policy call at a time, and commit all of them; returns the episode's folder in the store."""
        instruction, task = self.plan.settings.instruction, job.task
        state = joined(episode, self.state) if self.state else None
        actions = joined(episode, self.actions) if self.actions else None
        # What the policy reads is not known of every policy: with no camera in the layout, all columns are decoded.
        columns = tuple(self.cameras.values()) or None
        with self.run.episode(
            task_id=task.task_id,
            episode_index=job.episode_index,
            instruction=task.instruction,
            task_name=task.name,
        ) as recorded:
            for number, frame in enumerate(episode.frames(self.every, columns)):
                frame = frame if instruction is None else replace(frame, instruction=instruction)
                seed = noise_seed(self.seed, task.task_id, episode.index, number)
                torch.manual_seed(seed)
                # With no number in the layout, as many recorded actions are kept as the policy gives.
                last = frame.index + (self.given.layout.action_horizon or episode.length)
                with recorded.replan(
                    env_step=frame.index,
                    frames={camera: frame.images[column] for camera, column in self.cameras.items()},
                    state=None if state is None else state[frame.index],
                    instruction=frame.instruction,
                    noise_seed=seed,
                    dataset_actions=None if actions is None else actions[frame.index : last],
                ) as replan:
                    replan.actions = self.given.act(frame)
                yield
            recorded.success = success_of(episode)
            recorded.num_steps = episode.length
        assert recorded.folder is not None  # an episode without a recorded call is an error
        return recorded.folder


@dataclass
class RecordedByRun(Episode):
    """One episode. calls: makes one at a time, and commits them."""

    outcome: Outcome
    calls: Generator[None, None, Path]
    done: int = 0

    def poll(self) -> Committed | None:
        """Make the next call."""
        try:
            next(self.calls)
        except StopIteration as end:
            return Committed(self.outcome, self.done, end.value)
        self.done += 1
        return None

    def close(self, error: Exception | None = None) -> None:
        """Drop what was not committed."""
        self.calls.close()


def replay_with_file(arguments: argparse.Namespace, plan: ReplayPlan, given: ReplayPolicy) -> int:
    """Record the calls of the policy; returns the number of new episodes."""
    offered = _offered(plan.robot_data, given)
    layout = given.layout
    cameras = offered.match_cameras(layout.camera_names, {}, ()) if layout.camera_names else {}
    state, actions = _columns(offered, "state"), _columns(offered, "action")
    plan.data.check_files(plan.wanted, tuple(cameras.values()) or plan.data.cameras)
    every = plan.settings.every or given.every
    settings = recording_settings(arguments)
    if settings.queries not in ("mean", "all"):
        raise BadArgument(f"Cannot use --queries {settings.queries} with --policy FILE.py; expected mean or all.")
    interventions = read_interventions(arguments)
    of_attention = structs.replace(interventions, noise=None)  # the noise is drawn here
    base = _base_of(arguments, interventions)
    run = record(
        plan.store,
        given.policy,
        layout=layout,
        checkpoint=given.checkpoint,
        tokenizer=given.tokenizer,
        untrained=given.untrained,
        layers=settings.layers,
        denoise_steps=settings.denoise_steps,
        heads=settings.heads,
        queries="mean" if settings.queries == "mean" else "all",
        bits=settings.mantissa_bits,
        contributions=settings.contributions,
        frames=settings.frames,
        interventions=of_attention,
        allow_empty=arguments.allow_empty,
        provenance=plan.data.downloads | decoder_version(),
        resume=plan.mode == "resume",
        overwrite=plan.mode == "overwrite",
    )
    run.attributes = structs.replace(
        run.attributes,
        protocol=plan.protocol(every),
        data_set=plan.source(columns_of(cameras, state, actions), actions),
        interventions=interventions_for_store(interventions, run.attributes.interventions),
        rerun_of=None if base is None else RerunSource(run=base[1], name=arguments.rerun_of.name),
    )
    if base is not None:
        _check_base(arguments.rerun_of, base[0], run.attributes)
    sizes = [math.prod(picture_size(run.attributes.sites, camera)) * 3 for camera in cameras]
    with run:
        todo = announce_replay(plan, run.attributes, layout.action_horizon, sizes)
        seed = plan.settings.seed if interventions.noise is None else interventions.noise.seed
        source = FramesForFile(given, run, plan, every, seed, cameras, state, actions)
        added = record_episodes(plan, run.store, todo, every, source)
    if run.num_dropped:
        say(f"In {run.num_dropped} policy calls no attention ran; they are not in the store.")
    if added:
        say(
            f"Largest difference of P·V from the policy's own attention: {run.largest_error:.2g} of its largest output."
        )
    return added


def interventions_for_store(given: Interventions, recorded: Interventions) -> Interventions:
    """Return what the store says was changed: what the recorder changed, and the noise."""
    return recorded if given.noise is None else structs.replace(recorded, name=given.name, noise=given.noise)


def _base_of(arguments: argparse.Namespace, interventions: Interventions) -> tuple[RootAttributes, str] | None:
    """Return the attributes and the run of the base of a replay with interventions; None without one."""
    if arguments.rerun_of is None:
        return None
    if interventions.is_none:
        raise BadArgument("--rerun-of needs an intervention, for instance --knockout camera:NAME.")
    return read_run(arguments.rerun_of)


def _check_base(path: Path, base: RootAttributes, made: RootAttributes) -> None:
    """Raise `BadArgument` unless the calls of a replay are those of its base, but for the interventions."""
    for what, first, second in (
        ("weights", base.policy.digest, made.policy.digest),
        ("data set, or columns of it", base.data_set, made.data_set),
        ("--every or --seed", base.protocol, made.protocol),
        ("interventions of its own", base.interventions.is_none, True),
    ):
        if first != second:
            raise BadArgument(f"Cannot use --rerun-of {path}: its calls are other ones, with other {what}.")


def _offered(data: RobotData, given: ReplayPolicy) -> RobotData:
    """Return the data set's columns with the choices of the file, which those of the command line replace."""
    return replace(
        data,
        chosen_cameras={**given.cameras, **data.chosen_cameras},
        chosen_state=data.chosen_state or given.state,
        chosen_actions=data.chosen_actions or given.actions,
    )


def _columns(data: RobotData, what: str) -> tuple[str, ...]:
    """Return the columns of state or actions: those that were chosen, else the usual ones, none if there are none."""
    chosen = data.chosen_state if what == "state" else data.chosen_actions
    if chosen == (NONE,):
        return ()
    try:
        return data.state_columns() if what == "state" else data.action_columns()
    except BadArgument:
        if chosen:
            raise
        return ()
