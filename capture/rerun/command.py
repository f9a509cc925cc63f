"""`capture rerun`: check that stored policy calls come out as they did, and make them again into stores."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from vla_attention.capture.effects.conditions import refuse_both
from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.effects.prompt_tables import with_rows
from vla_attention.capture.engine.plan import plan_recording
from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.settings import RecordingSettings, recording_settings
from vla_attention.capture.interventions.resolution import check_places, interventions_for
from vla_attention.capture.machine import describe_machine, load_torch
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.rerun.arguments import RerunOutput, RerunSettings
from vla_attention.capture.rerun.base_store import (
    check_may_change,
    check_same_policy,
    families_of,
    open_base,
    scenes_of,
)
from vla_attention.capture.rerun.interventions_of_rerun import check_on_store, rerun_interventions, told
from vla_attention.capture.rerun.rerun_store import Rerun
from vla_attention.capture.rerun.stored_calls import check_has_inputs
from vla_attention.capture.store.store_writer import check_target
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.options import read_options
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_url import local_path
from vla_attention.schemas.threads import Threads


def run_rerun(arguments: argparse.Namespace, threads: Threads, termination: Termination) -> int:
    """Run `vla-attention capture rerun` on parsed arguments; returns the exit code."""
    settings, output = read_options(RerunSettings, arguments), read_options(RerunOutput, arguments)
    recording = recording_settings(arguments)
    base = open_base(arguments.base, settings.tasks, settings.num_episodes)
    effects = with_rows(recording.effects, base.suite, families_of(base), scenes_of(base))
    recording = replace(recording, effects=effects)
    interventions = rerun_interventions(arguments)
    check_may_change(base, interventions)
    # All mistakes that need no model are errors now, before the minutes for loading one. Those of the changes come
    # first: whoever asks for a layer that there is not would not be helped by another place for the store.
    check_places(interventions, base.attributes.policy)
    nothing_changes = check_on_store(interventions, base, allow_empty=arguments.allow_empty)
    target = _target(output, base, interventions, effects=recording.effects is not None)
    if target is not None:
        check_target(target, output.mode)
    for line in nothing_changes:
        say(line)
    if recording.effects is not None:
        refuse_both(interventions)
        refuse_both(base.attributes.interventions)
    arguments.instructions = told(base, interventions.prompt)
    rerun = _prepare(arguments, recording, base, threads, termination)
    interventions = interventions_for(interventions, rerun.policy)
    rerun.check(settings.check)
    if target is None:
        return 0
    if not interventions.is_none:
        say(f"Interventions: {interventions.describe()}.")
    say(rerun.describe_disk(target, [episode.attributes.num_replans for episode in base.episodes]))
    added = rerun.write(target, output.mode, interventions, allow_empty=arguments.allow_empty)
    say(f"{plural(added, 'episode')} added. Store: {target}")
    rerun.faults.raise_missing()
    if rerun.recording.effects is not None:
        say(f"Next: vla-attention effects {target}")
        return 0
    say(
        f"Next: vla-attention analyze {target}"
        if interventions.is_none
        else f"Next: vla-attention compare {base.path} {target}"
    )
    return 0


def _target(output: RerunOutput, base: Store, interventions: Interventions, *, effects: bool) -> Path | None:
    """Return the store to write; None if only the check was asked for."""
    if output.store is not None:
        target = output.store
    elif interventions.is_none and not effects and output.output_dir is None:
        return None
    else:
        name = "effects" if effects and interventions.is_none else file_part(interventions.name) or "rerun"
        folder = output.output_dir or local_path(base.path).parent
        target = folder / f"{base.path.stem}_{name}{STORE_SUFFIX}"
    if target.resolve() == base.path.resolve():
        raise BadArgument(f"Cannot write the rerun of {base.path} into the store itself; give another --output.")
    return target


def _noise_seed(arguments: argparse.Namespace, base: Store) -> int:
    """Return the seed that the noise of the calls is drawn from."""
    given = [arguments.noise_seed, base.attributes.interventions.noise and base.attributes.interventions.noise.seed]
    return next((seed for seed in given if seed is not None), base.attributes.protocol.seed)


def _prepare(
    arguments: argparse.Namespace, settings: RecordingSettings, base: Store, threads: Threads, termination: Termination
) -> Rerun:
    """Load the policy, and check that it is the store's."""
    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    family: PolicyFamily = arguments.family
    policy = family.read(arguments).build(device)
    identity = policy.identity()
    check_same_policy(base, identity, policy.sites)
    check_has_inputs(base, policy)
    recording, note = plan_recording(settings, policy, _noise_seed(arguments, base))
    if note:
        say(note)
    say(f"Policy: {identity.name} ({identity.checkpoint_format}: {identity.checkpoint}), weights as in {base.path}.")
    pictures = pictures_of(settings.effects, policy, base.suite, base)
    return Rerun(
        policy, base, recording, describe_machine(device) | downloads_of(policy), termination, pictures=pictures
    )
