"""What is recorded of each policy call: the plan for a policy, and a store's root."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from vla_attention.capture.engine.progress import say
from vla_attention.capture.policies.identity import announcement
from vla_attention.capture.store.disk_estimate import DiskEstimate, describe
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    STORE_VERSION,
    DataSetSource,
    PolicyIdentity,
    Protocol,
    Recording,
    RootAttributes,
)
from vla_attention.schemas.stores.verify import DamagedEpisode

if TYPE_CHECKING:
    from vla_attention.capture.engine.settings import RecordingSettings
    from vla_attention.capture.policies.policy import ModelSizes, Policy

_QUERIES = {"mean": "the mean over", "steps": "the action steps' means over", "all": "each of"}


def plan_recording(settings: RecordingSettings, policy: Policy, seed: int) -> tuple[Recording, str | None]:
    """Check the settings against the policy; also returns a line to print if layer numbers were translated.

    seed: of the run's noise.
    """
    if len(set(settings.heads or ())) != len(settings.heads or ()):
        raise BadArgument(f"Heads {listing(settings.heads or ())} name one of them twice.")
    num_pools = len(policy.query_pools()) if settings.queries == "steps" else 0
    recording, note = recording_of(settings, policy, policy.num_action_queries, num_pools)
    if settings.effects is None:
        return recording, note
    from vla_attention.capture.effects.conditions import planned_effects

    return replace(recording, effects=planned_effects(settings.effects, policy, seed)), note


def recording_of(
    settings: RecordingSettings, model: ModelSizes, num_action_queries: int, num_pools: int = 0
) -> tuple[Recording, str | None]:
    """Check layers, heads and denoise steps against the model.

    num_action_queries, num_pools: of a policy call. Also returns a line to print if layer numbers were translated.
    """
    layers = select_layers(settings.layers, model.num_layers, model.family)
    heads = tuple(range(model.num_heads)) if settings.heads is None else settings.heads
    for head in heads:
        if not 0 <= head < model.num_heads:
            raise BadArgument(f"There is no head {head}; expected 0 to {model.num_heads - 1}.")
    recording = Recording(
        layers=tuple(sorted(set(layers.blocks))),
        layer_labels=tuple(sorted(layers.labels, key=lambda label: (label % model.num_layers, label))),
        denoise_steps=_denoise_steps(settings.denoise_steps, model.num_denoise_steps),
        heads=tuple(sorted(set(heads))),
        queries=settings.queries,
        num_action_queries=num_action_queries,
        num_pools=num_pools,
        mantissa_bits=settings.mantissa_bits,
        frames=settings.frames,
        contributions=settings.contributions,
    )
    return recording, layers.note


def _denoise_steps(words: Sequence[int | str], count: int) -> tuple[int, ...]:
    named = {"first": (0,), "last": (count - 1,), "all": tuple(range(count))}
    steps: set[int] = set()
    for word in words:
        if word in named:
            steps.update(named[str(word)])
        elif str(word).isdigit() and int(word) < count:
            steps.add(int(word))
        else:
            raise BadArgument(
                f"There is no denoise step {word!r}; expected numbers 0 to {count - 1}, 'first', 'last' or 'all'."
            )
    return tuple(sorted(steps))


def root_attributes(
    identity: PolicyIdentity,
    sites: tuple[SiteLayout, ...],
    protocol: Protocol,
    recording: Recording,
    machine: Mapping[str, str],
    *,
    interventions: Interventions | None = None,
    rerun_of: RerunSource | None = None,
    data_set: DataSetSource | None = None,
) -> RootAttributes:
    """Return what the root of a run's store says. machine: provenance of the process that makes it."""
    return RootAttributes(
        format=FORMAT_NAME,
        store_version=STORE_VERSION,
        policy=identity,
        protocol=protocol,
        recording=recording,
        sites=sites,
        provenance=dict(machine),
        interventions=interventions or Interventions(),
        rerun_of=rerun_of,
        data_set=data_set,
    )


def announce(
    attributes: RootAttributes,
    source: Sequence[str],
    bound: DiskEstimate,
    store: Path,
    wanted: int,
    damaged: Sequence[DamagedEpisode],
) -> None:
    """Print what a run records, the disk that it can take, and what its store has already.

    source: lines on where the policy calls come from. bound: of the episodes that are missing. wanted: number of the
    episodes that were asked for. damaged: those that are in the store and cannot be used.
    """
    recording, todo = attributes.recording, bound.num_episodes
    lines = [*announcement(attributes.policy), *source]
    if not attributes.interventions.is_none:
        lines.append(f"Interventions: {attributes.interventions.describe()}.")
    lines.append(
        f"Recording {len(recording.layers)} layers, denoise steps {listing(recording.denoise_steps)}, "
        f"{len(recording.heads)} heads, {_QUERIES[recording.queries]} {recording.num_action_queries} action queries, "
        f"{', '.join(str(site.num_keys) for site in attributes.sites)} keys."
    )
    if recording.effects is not None:
        from vla_attention.capture.effects.conditions import describe_effects

        lines.append(describe_effects(recording.effects))
    lines.append(describe(bound, store))
    if todo < wanted:
        of_damaged = f" and {len(damaged)} damaged" if damaged else ""
        complete = wanted - todo - len(damaged)
        lines.append(f"{complete} of {wanted} episodes are complete already{of_damaged}; {todo} to run.")
    lines += [f"Not recorded again without vla-attention capture verify --repair: {one.describe()}" for one in damaged]
    for line in lines:
        say(line)
