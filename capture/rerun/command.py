"""`vla-capture rerun`: check that stored policy calls come out as they did, and make them again into stores."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.capture.effects.arguments import NO_EFFECTS, effect_settings
from vla_attention.capture.effects.conditions import refuse_both
from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.engine.plan import plan_recording, recording_settings
from vla_attention.capture.engine.progress import say
from vla_attention.capture.interventions.resolution import check_not_compiled, check_places, interventions_for
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.machine import describe_machine, load_torch
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.rerun.base_store import check_may_change, check_same_policy, open_base
from vla_attention.capture.rerun.interventions_of_rerun import check_on_store, rerun_interventions
from vla_attention.capture.rerun.rerun_store import Rerun
from vla_attention.capture.rerun.series import SeriesRun
from vla_attention.capture.rerun.stored_calls import check_has_inputs
from vla_attention.capture.store.store_writer import WriteMode, check_target
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_url import local_path
from vla_attention.schemas.threads import Threads


def run_rerun(arguments: argparse.Namespace, threads: Threads, termination: Termination) -> int:
    """Run `vla-attention capture rerun` on parsed arguments; returns the exit code."""
    if arguments.check is not None and arguments.check < 0:
        raise BadArgument(f"Cannot use --check {arguments.check}; expected 0 or more policy calls.")
    base = open_base(arguments.base, arguments.task_id, arguments.num_episodes)
    if arguments.series is not None:
        check_not_compiled(base.attributes.policy)
        series = SeriesRun.planned(arguments, base)
        rerun = _prepare(arguments, base, threads, termination)
        series.write(rerun, rerun.check(arguments.check))
        rerun.faults.raise_missing()
        return 0
    _refuse_options_of_series(arguments)
    interventions = rerun_interventions(arguments)
    check_may_change(base, interventions)
    if interventions.changes_attention:
        check_not_compiled(base.attributes.policy)
    # All mistakes that need no model are errors now, before the minutes for loading one. Those of the changes come
    # first: whoever asks for a layer that there is not would not be helped by another place for the store.
    check_places(interventions, base.attributes.policy)
    nothing_changes = check_on_store(interventions, base, allow_empty=arguments.allow_empty)
    target = _target(arguments, base, interventions)
    mode: WriteMode = "overwrite" if arguments.overwrite else "resume" if arguments.resume else "new"
    if target is not None:
        check_target(target, mode)
    for line in nothing_changes:
        say(line)
    if arguments.effects != NO_EFFECTS:
        refuse_both(interventions)
        refuse_both(base.attributes.interventions)
    rerun = _prepare(arguments, base, threads, termination)
    interventions = interventions_for(interventions, rerun.policy)
    rerun.check(arguments.check)
    if target is None:
        return 0
    if not interventions.is_none:
        say(f"Interventions: {interventions.describe()}.")
    say(rerun.describe_disk(target, [episode.attributes.num_replans for episode in base.episodes]))
    added = rerun.write(target, mode, interventions, allow_empty=arguments.allow_empty)
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


def _refuse_options_of_series(arguments: argparse.Namespace) -> None:
    for option, given in (
        ("--words", arguments.words),
        ("--objects", arguments.objects),
        ("--output-dir", arguments.output_dir is not None),
    ):
        if given:
            raise BadArgument(f"{option} belongs to a series; give --series GROUPING too, for instance default.")


def _target(arguments: argparse.Namespace, base: Store, interventions: Interventions) -> Path | None:
    """Return the store to write; None if only the check was asked for."""
    if arguments.store is not None:
        target = Path(arguments.store)
    elif interventions.is_none and arguments.effects == NO_EFFECTS:
        return None
    elif interventions.is_none:
        target = local_path(base.path).with_name(f"{base.path.stem}_effects{STORE_SUFFIX}")
    else:
        target = local_path(base.path).with_name(f"{base.path.stem}_{file_part(interventions.name)}{STORE_SUFFIX}")
    if target.resolve() == base.path.resolve():
        raise BadArgument(f"Cannot write the rerun of {base.path} into the store itself; give another --output.")
    return target


def _noise_seed(arguments: argparse.Namespace, base: Store) -> int:
    """Return the seed that the noise of the calls is drawn from."""
    given = [arguments.noise_seed, base.attributes.interventions.noise and base.attributes.interventions.noise.seed]
    return next((seed for seed in given if seed is not None), base.attributes.protocol.seed)


def _prepare(arguments: argparse.Namespace, base: Store, threads: Threads, termination: Termination) -> Rerun:
    """Load the policy, and check that it is the store's."""
    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    family: PolicyFamily = arguments.family
    policy = family.build(arguments, device)
    identity = policy.identity()
    check_same_policy(base, identity, policy.sites)
    check_has_inputs(base, policy)
    recording, note = plan_recording(recording_settings(arguments), policy, _noise_seed(arguments, base))
    if note:
        say(note)
    say(f"Policy: {identity.name} ({identity.checkpoint_format}: {identity.checkpoint}), weights as in {base.path}.")
    pictures = pictures_of(effect_settings(arguments), policy, base.suite, base)
    return Rerun(
        policy, base, recording, describe_machine(device) | downloads_of(policy), termination, pictures=pictures
    )
