"""Reruns of whole episodes into a store, which is like any other: rows, actions, roles and pictures of every replan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.rerun.calls import Repeater
from vla_attention.capture.rerun.progress import RerunProgress
from vla_attention.capture.rerun.stored_calls import StoredCalls, read_calls
from vla_attention.capture.rollout.episode_faults import Faults
from vla_attention.capture.rollout.policy_call import replan_record
from vla_attention.capture.store.episode_writer import EpisodeStart, ReplanRefused
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import StoreExists, parse_episode_name


def rerun_episodes(
    repeater: Repeater,
    store: RunStore,
    episodes: Sequence[StoredEpisode],
    machine: Mapping[str, str],
    progress: RerunProgress,
    termination: Termination,
    faults: Faults,
) -> int:
    """Rerun the episodes that the store lacks; returns their number. An episode with a fault is left out and noted.

    Raises:
        Terminated: SIGTERM was received; the episode in progress was dropped.
        CorruptEpisode: an episode is damaged. Those before it stay.
    """
    added = 0
    for episode in episodes:
        again = True
        while again:
            again = False
            termination.check()
            # Another process may run the same command, and have committed an episode meanwhile.
            if store.has(*parse_episode_name(episode.name)):
                break
            try:
                with termination.only_at_checks(), suppress(StoreExists):
                    rerun_episode(repeater, store, read_calls(episode), machine, progress, termination)
                    added += 1
            except (NumbersNotFinite, ReplanRefused) as error:
                again = faults.note(episode.name, error)
                progress.say(f"{episode.name}: {error} {'It begins again.' if again else 'It is left out.'}")
    return added


def rerun_episode(
    repeater: Repeater,
    store: RunStore,
    calls: StoredCalls,
    machine: Mapping[str, str],
    progress: RerunProgress,
    termination: Termination,
) -> Path:
    """Rerun one episode and commit it; returns its folder.

    Outcome, number of steps, environment steps and object coverage are those of the stored episode: nothing is
    executed. With interventions the stored actions are kept beside the changed ones, to know the base again by them.
    """
    attributes, recording = calls.attributes, store.attributes.recording
    start = EpisodeStart(
        task_id=attributes.task_id,
        task_name=attributes.task_name,
        instruction=attributes.instruction,
        episode_index=attributes.episode_index,
        initial_state_index=attributes.initial_state_index,
        initial_state_digest=attributes.initial_state_digest,
        objects=attributes.objects,
        provenance=dict(machine),
        task_family=attributes.task_family,
    )
    denoise_times = repeater.policy.denoise_times()[list(recording.denoise_steps)]
    progress.begin(calls.episode.name)
    with store.episode(start, np.asarray(denoise_times), calls.num_replans) as writer:
        for replan in range(calls.num_replans):
            termination.check()
            policy_input = repeater.prepare(calls, replan)
            call = repeater.call(calls, replan, policy_input)
            writer.append(
                replan_record(
                    policy_input,
                    call,
                    recording,
                    env_step=int(calls.env_step[replan]),
                    noise_seed=repeater.noise_seed(calls, replan),
                    coverage=calls.coverage_of(replan),
                    dataset_actions=calls.dataset_actions_of(replan),
                    base_actions=None if store.attributes.interventions.is_none else calls.actions[replan],
                )
            )
            progress.update(replan + 1, calls.num_replans)
        folder = writer.commit(attributes.success, attributes.num_steps)
    progress.end(calls.num_replans)
    return folder
