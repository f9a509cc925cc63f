"""The interventions of a run: names before it, empty groups in it, and a check of all stored replans."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kit.policy_inputs import make_observation
from tests.kit.stores import write_store
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.interventions.run_changes import RunChanges, check_stored_replans
from vla_attention.capture.policies.pi.embedded import dummy_policy
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import Interventions, KeyKnockout, PromptChange
from vla_attention.schemas.stores.reader import open_store

BOWL = SceneObject("bowl_1", "object", True)


def changes(*selectors: str, **fields) -> RunChanges:
    interventions = Interventions(keys=tuple(KeyKnockout(selector) for selector in selectors))
    return RunChanges(interventions, {0: "pick up the bowl", 4: "open the drawer"}, **fields)


@pytest.fixture(scope="module")
def policy():
    return dummy_policy()


def editors(given: RunChanges, policy, covered: float = 0.0, replan: int = 0):
    policy_input = policy.prepare(make_observation(0), "pick up the bowl")
    camera = policy.cameras[0].name
    coverage = {camera: np.array([[covered], [0], [0], [0]], dtype=np.float32)}
    return given.editors(policy.sites, policy_input, CallContext(0, 0, replan, objects=[BOWL], coverage=coverage))


def test_names_before_the_run(policy):
    changes("object:anything", "word:drawer", "role:image").check_names(policy.sites)
    with pytest.raises(SelectorError, match="'mug'"):
        changes("word:mug").check_names(policy.sites)
    mug = Interventions(keys=(KeyKnockout("word:mug"),), prompt=PromptChange("text", text="take the mug"))
    RunChanges(mug, {0: "pick up the bowl"}).check_names(policy.sites)
    with pytest.raises(SelectorError, match="'plate_1'"):
        editors(changes("object:plate_1"), policy)


def test_all_stored_replans(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr", tasks=(0, 1), episodes=2, replans=3))
    tokens = store.episodes[0].tokens(store.attributes, "joint")
    camera = tokens.layout.cameras[0]
    assert check_stored_replans(Interventions(keys=(KeyKnockout(f"camera:{camera}"),)), store) == 0
    assert check_stored_replans(Interventions(), store) == 0
    with pytest.raises(SelectorError, match="'nowhere'"):
        check_stored_replans(Interventions(keys=(KeyKnockout("camera:nowhere"),)), store)
    nothing = Interventions(keys=(KeyKnockout(f"camera:{camera} & role:action"),))
    with pytest.raises(EmptyGroup, match=r"12 of 12 replans, .* replan 0 of task000_episode000"):
        check_stored_replans(nothing, store)
    assert check_stored_replans(nothing, store, allow_empty=True) == 12
