"""`va.record`: from its arguments to a run that is ready to record."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from msgspec.structs import replace

from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.effects.conditions import refuse_both
from vla_attention.capture.engine.plan import recording_of, root_attributes
from vla_attention.capture.engine.settings import RecordingSettings
from vla_attention.capture.machine import describe_machine
from vla_attention.capture.torch_policies.knockouts import check_interventions
from vla_attention.capture.torch_policies.own_setting import facts_of_own_setting
from vla_attention.capture.torch_policies.policy_layout import (
    LayoutForAnotherVersion,
    PolicyLayout,
    RecordedSite,
    check_is_layout,
    check_versions,
)
from vla_attention.capture.torch_policies.policy_weights import device_and_dtype, policy_digest
from vla_attention.capture.torch_policies.prompts import TokenText
from vla_attention.capture.torch_policies.repeated_calls import effects_of_layout
from vla_attention.capture.torch_policies.session import RecordedRun
from vla_attention.schemas.errors import BadArgument, Note, listing, unknown_name
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS
from vla_attention.schemas.stores.store_format import (
    CALLERS_MODULES,
    PolicyCameraView,
    PolicyIdentity,
    Protocol,
    Recording,
)

#: Libraries of policies whose versions can change numbers.
_LIBRARIES = ("transformers", "lerobot", "diffusers", "timm", "flash-attn", "peft")


def record(
    store: str | Path,
    policy: object,
    *,
    layout: PolicyLayout,
    suite: str = "recorded",
    checkpoint: str = "",
    tokenizer: Any = None,
    untrained: bool = False,
    layers: Sequence[int] | None = None,
    denoise_steps: Sequence[int | str] = ("first", "last"),
    heads: Sequence[int] | None = None,
    queries: Literal["mean", "all"] = "mean",
    bits: int = 10,
    contributions: bool = True,
    frames: bool = True,
    mirrored: Collection[str] = (),
    effects: str | EffectSettings | None = None,
    interventions: Interventions | None = None,
    allow_empty: bool = False,
    own_setting: Callable[[], Any] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    any_version: bool = False,
    provenance: Mapping[str, str] | None = None,
    durable: bool = True,
) -> RecordedRun:
    """Record the attention of a policy that your own code calls; returns a run for a `with` block.

    >>> import vla_attention as va
    >>> with va.record(store, policy, layout=layout) as run:
    ...     for number in range(2):
    ...         with run.episode(task_id=0, episode_index=number, instruction="pick the bowl") as episode:
    ...             for step in range(0, 30, 10):
    ...                 with episode.replan(env_step=step) as replan:
    ...                     replan.actions = policy.act(step)
    ...             episode.success = True
    >>> va.open(store).analyze()["tasks"].filter(scope="task")["instruction"][0]
    'pick the bowl'

    Args:
        store: the store to write, `NAME.zarr`.
        policy: an `nn.Module`, or an object that has modules as attributes.
        layout: what its attention calls are (`va.layouts`, or docs/my-policy.md).
        suite: your name for the tasks.
        checkpoint: where the weights come from, for the store.
        tokenizer: the policy's own; with it the prompt's tokens have words. None: the layout's text, if it has none.
        untrained: the weights are random.
        layers, denoise_steps, heads: what is recorded; None is everything. `first`, `last` and `all` are denoise steps.
        queries: `mean` over the action queries, or `all` of them.
        bits: precision of the stored rows in mantissa bits; 23 is exact.
        contributions: also what each part of the keys adds to the residual stream, gates and norms included
            (docs/my-policy.md, "Contributions"). It is an error at a policy call that does not show it.
        frames: store the pictures that replans are given.
        mirrored: cameras whose pictures have left and right exchanged, as those of LIBERO that are turned by 180
            degrees: they are stored as the policy gets them, and shown as a person sees the scene.
        effects: what is taken away from each call, one at a time, to see how the action changes: `text`, `cameras`,
            `objects`, `tokens`, with commas between, or `EffectSettings`. Each replan then needs `repeat`
            (docs/my-policy.md, "Effects").
        interventions: what is changed in the attention of the action queries, as `va.knockout("word:bowl")` says it.
        allow_empty: leave a replan unchanged where a group of them has no key.
        own_setting: a policy call that can be repeated, `lambda: policy.select_action(batch)`: it is made once as you
            make it and once as it is recorded, and the difference goes into the store. Two further calls check that the
            rows of its batch are apart.
        resume, overwrite: continue a store, or delete it first.
        any_version: accept other versions of libraries than those that the layout was written for.
        provenance: further facts for the store.
        durable: flush every episode to disk, so that it survives a crash of the machine.

    Raises:
        StoreExists: a store is there, and neither `resume` nor `overwrite` is given.
        RunMismatch: `resume` with other settings than those of the store.
        LayoutForAnotherVersion: the layout was written for other libraries than those that are installed.
        BatchRowsMixed: a change of one row of the batch of `own_setting` changes the actions of another.
        BadArgument: a number of a layer, head or denoise step does not exist.
    """
    check_is_layout(layout)
    if resume and overwrite:
        raise BadArgument("Give resume=True or overwrite=True, not both.")
    installed = {library: installed_version(library) for library in (*layout.versions, *_LIBRARIES)}
    other = check_versions(layout, installed)
    if other is not None and not any_version:
        raise LayoutForAnotherVersion(other)
    if queries not in ("mean", "all"):
        raise BadArgument(f"Cannot record the queries '{queries}'; expected 'mean' or 'all'.")
    if queries == "all" and layout.stops_early:
        raise BadArgument(
            f"Cannot record all action queries of '{layout.name}': it may generate fewer than "
            f"{layout.num_action_tokens} tokens. Record their mean."
        )
    if not 1 <= bits <= FLOAT32_MANTISSA_BITS:
        raise BadArgument(f"Cannot store rows with {bits} mantissa bits; expected 1 to {FLOAT32_MANTISSA_BITS}.")
    settings = RecordingSettings(
        layers=None if layers is None else tuple(layers),
        denoise_steps=(denoise_steps,) if isinstance(denoise_steps, (int, str)) else tuple(denoise_steps),
        heads=None if heads is None else tuple(heads),
        queries=queries,
        mantissa_bits=bits,
        frames=frames,
        contributions=contributions,
    )
    recording, _ = recording_of(settings, layout, max(num_action_queries(layout, site) for site in layout.sites))
    changes = interventions or Interventions()
    check_interventions(changes, layout)
    planned = effects_of_layout(effects, layout)
    if planned is not None:
        refuse_both(changes)
        recording = replace(recording, effects=planned)
    mirrored = (mirrored,) if isinstance(mirrored, str) else tuple(mirrored)
    for camera in mirrored:
        if camera not in layout.camera_names:
            raise unknown_name("camera", camera, layout.camera_names)
    device, dtype = device_and_dtype(policy)
    facts = describe_machine(device)
    facts |= {library: version for library, version in installed.items() if version is not None}
    facts |= {"layout for another version": other} if other is not None else {}
    facts["difference to own setting"] = "not measured"
    if own_setting is not None:
        facts |= facts_of_own_setting(policy, layout, own_setting)
    digest, unread = policy_digest(policy)
    if unread:
        facts["not in the digest of weights"] = listing(unread)
        warnings.warn(
            f"The digest of the policy's weights is without {listing(unread)}, which cannot be read: offloaded, no "
            "numbers, or made at the first call (make one before va.record). A change of these is not noticed.",
            Note,
            stacklevel=3,
        )
    facts |= dict(provenance or {})
    attributes = root_attributes(
        _identity(policy, layout, checkpoint, digest, dtype, mirrored, untrained=untrained),
        recorded_sites(layout, recording),
        Protocol(suite=suite, seed=0, wait_steps=0, replan_steps=0, max_steps=0, name="recorded", image_size=0),
        recording,
        facts,
        interventions=changes,
    )
    return RecordedRun(
        Path(store),
        policy,
        layout,
        attributes,
        "resume" if resume else "overwrite" if overwrite else "new",
        allow_empty=allow_empty,
        tokenizer=None if tokenizer is None else TokenText(tokenizer),
        durable=durable,
    )


def num_action_queries(layout: PolicyLayout, site: RecordedSite) -> int:
    """Return how many action queries a policy call has at a site."""
    return layout.num_action_tokens if layout.autoregressive else site.num_action_queries


def recorded_sites(layout: PolicyLayout, recording: Recording) -> tuple[SiteLayout, ...]:
    """Return the sites that some recorded layer has, as the store describes them."""
    stored = []
    for site in layout.sites:
        if site.is_in(recording.layers):
            count = num_action_queries(layout, site)
            stored.append(replace(site.keys, num_action_queries=count * (count != recording.num_action_queries)))
    if not stored:
        raise BadArgument(f"The layers {listing(recording.layers)} have none of the sites.")
    return tuple(stored)


def _identity(
    policy: object,
    layout: PolicyLayout,
    checkpoint: str,
    digest: str,
    dtype: str,
    mirrored: Collection[str],
    *,
    untrained: bool,
) -> PolicyIdentity:
    # Row 0 of what the policy gets is on top.
    views = tuple(PolicyCameraView(name, name, upright=True, mirrored=name in mirrored) for name in layout.camera_names)
    return PolicyIdentity(
        name=layout.name,
        family=layout.family,
        checkpoint=checkpoint or "not given",
        checkpoint_format=CALLERS_MODULES,
        digest=digest,
        untrained=untrained,
        num_layers=layout.num_layers,
        num_heads=layout.num_heads,
        num_denoise_steps=layout.num_denoise_steps,
        action_horizon=layout.action_horizon,
        cameras=views,
        config={
            "class": f"{type(policy).__module__}.{type(policy).__qualname__}",
            "dtype": dtype,
            **layout.config,
            "layout": to_json(replace(layout, versions={}, config={})),
        },
    )


def installed_version(library: str) -> str | None:
    """Return the version of an installed library, or None."""
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return None
