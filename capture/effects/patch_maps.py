"""Which patches move the actions of a call: all of them by first order, the strongest by exact knock-outs.

The two are kept apart (`EffectMap`): the first order is an order of the patches, and sizes are of exact knock-outs
alone. Some of the others, drawn at random, are knocked out too: how their order agrees with their exact one says how
far the map can be trusted. `benchmarks/effect_maps.py` measures both against the exact knock-outs of every patch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.factors import SiteEdit, SiteEditor
from vla_attention.capture.policies.policy import CallVariant, MapPolicy, Policy, PolicyInput, UnitsPolicy, map_keys
from vla_attention.capture.store.replan_records import ReplanMap
from vla_attention.schemas.layout import Role

#: Directions of the first order, the part of the patches that are knocked out exactly, and how many at random.
PROJECTIONS, STRONGEST, DRAWN = 8, 0.15, 10


@dataclass(frozen=True)
class PatchOrder:
    """The first order of one call.

    Attributes:
        keys: of the patches.
        sizes: (patch,) float32.
        chosen: the places of the patches that are knocked out, and whether each was drawn at random.
        steps: of the chunk that count.
    """

    keys: tuple[int, ...]
    sizes: NDArray[np.float32]
    chosen: Mapping[int, bool]
    steps: int

    def variants(self, policy: Policy, policy_input: PolicyInput, noise_seed: int) -> dict[int, CallVariant]:
        """The calls without each chosen patch, by its place."""
        site, found = policy.sites[0], {}
        for place in self.chosen:
            factors = np.ones(site.num_keys)
            factors[self.keys[place]] = 0.0
            editor = SiteEditor(site.name, [SiteEdit(f"patch {place}", "factor", factors, "all")])
            found[place] = CallVariant(policy_input, noise_seed, {site.name: editor})
        return found

    def stored(self, policy: Policy, changes: Mapping[int, NDArray[np.float32]], shape: tuple[int, ...]) -> ReplanMap:
        """What is stored, with the changes of patches by their places, each of a shape (horizon, action dim).

        Those that are not finite are left out.
        """
        kept = [place for place in self.chosen if place in changes and np.isfinite(changes[place]).all()]
        change = np.stack([changes[place] for place in kept]) if kept else np.zeros((0, *shape), np.float32)
        drawn = tuple(self.chosen[place] for place in kept)
        site = policy.sites[0].name
        return ReplanMap(site, self.keys, PROJECTIONS, self.steps, self.sizes, tuple(kept), drawn, change)


def patch_order(
    policy: Policy, policy_input: PolicyInput, noise_seed: int, steps: int, horizon: int, seed: tuple[int, ...]
) -> PatchOrder | None:
    """Return the first order of a call; None where it is not finite.

    steps: of the chunk of `horizon` actions that are executed. seed: of the directions, and of the patches that are
    drawn.
    """
    generator, keys = np.random.default_rng(seed), map_keys(policy)
    units, made_by = cast(UnitsPolicy, policy).action_units(), cast(MapPolicy, policy)
    signs = np.zeros((PROJECTIONS, horizon, len(units)), np.float32)
    moved = np.flatnonzero(units)
    signs[:, :steps, moved] = generator.choice([-1.0, 1.0], (PROJECTIONS, steps, len(moved)))
    gradients = made_by.patch_gradients(policy_input, noise_seed, signs / np.float32((steps * len(moved)) ** 0.5))
    sizes = np.sqrt((gradients.astype(np.float64) ** 2).mean(axis=0)).astype(np.float32)
    if not np.isfinite(sizes).all():
        return None
    seen = np.flatnonzero(policy_input.key_role[policy.sites[0].name][list(keys)] == Role.IMAGE)
    by_size = seen[np.argsort(-sizes[seen], kind="stable")]
    strongest = round(STRONGEST * len(seen))
    chosen = {int(place): False for place in by_size[:strongest]}
    chosen |= {int(place): True for place in generator.permutation(by_size[strongest:])[:DRAWN]}
    return PatchOrder(keys, sizes, chosen, steps)
