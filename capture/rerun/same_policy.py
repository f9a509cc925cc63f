"""The check that a policy is the one of a store, and its differences in words."""

from __future__ import annotations

from collections.abc import Mapping

from vla_attention.capture.provenance import POLICY_BATCH
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import PolicyIdentity, RootAttributes

#: Fields of a policy's identity that name places, or where a configuration came from; they decide no number.
_PLACES = ("name", "checkpoint", "config.configuration", "config.text_encoder")


class OtherPolicy(UserError, ValueError):
    """The policy is another one than that of the store."""


def check_same_policy(store: Store, identity: PolicyIdentity, sites: object) -> None:
    """Raise `OtherPolicy` unless weights, configuration and layout are those of the store.

    Facts that a later version of this program added to the configuration are not in the store, and are not compared.
    """
    root: RootAttributes = store.attributes
    stored = root.policy
    if identity.digest != stored.digest:
        raise OtherPolicy(
            f"Cannot rerun {store.path}: its weights have the digest {stored.digest[:12]} ({stored.name}: "
            f"{stored.checkpoint}), and those of '{identity.checkpoint}' have {identity.digest[:12]}; give the "
            "--checkpoint that was captured."
        )
    difference = _first_difference(to_json(stored), to_json(identity), "")
    if difference is None and to_json(root.sites) != to_json(sites):
        difference = "sites", "the one", "another"
    if difference is not None:
        where, old, new = difference
        raise OtherPolicy(
            f"Cannot rerun {store.path}: its policy has the {where} {old!r}, and this one has {new!r}; give the model "
            "options of the capture."
        )


def _first_difference(old: object, new: object, where: str) -> tuple[str, object, object] | None:
    if where in _PLACES:
        return None
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key, value in old.items():
            found = _first_difference(value, new.get(key), f"{where}.{key}".lstrip("."))
            if found:
                return found
        return None
    return None if old == new else (where, old, new)


def machine_differences(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return what differs between the machine of an episode and this one, as `torch 2.9 then, 2.10 now`."""
    single = {POLICY_BATCH: "1"}
    then, now = single | dict(then), single | dict(now)
    facts = [name for name in then if name in now and then[name] != now[name]]
    return [f"{name} {then[name]} then, {now[name]} now" for name in facts]
