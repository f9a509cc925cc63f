"""Layouts are plain data that go to JSON and back, and say what is wrong in them."""

import json
import re

import pytest
from msgspec.structs import replace

from tests.kit.paths import ROOT
from vla_attention.capture.torch_policies.policy_layout import (
    CallRule,
    CameraPicture,
    PolicyLayout,
    PromptText,
    RecordedSite,
)
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.jsonable import from_json, to_json
from vla_attention.schemas.layout import ROLES_OF_KIND, PatchGrid, Role, SiteLayout, Span

KEYS = SiteLayout(
    "joint",
    (
        Span("image_front", "image", 0, 4, "front", PatchGrid(2, 2, 8, 8)),
        Span("prompt", "text", 4, 10),
        Span("actions", "action", 10, 13),
    ),
)
ROLES = {"image_front": "image", "prompt": "instruction", "actions": "action"}
SITE = RecordedSite(KEYS, (-3, None), ROLES, "prompt")
LAYOUT = PolicyLayout(
    name="small",
    family="small",
    sites=(SITE,),
    rules=(CallRule(r"blocks\.(?P<block>\d+)\.attention", "joint", queries=3), CallRule("vision.*", None)),
    num_layers=2,
    num_heads=2,
    num_denoise_steps=4,
    denoise_times=(1.0, 0.75, 0.5, 0.25),
    cameras=(CameraPicture("front", "pad"),),
    text=PromptText(("prompt",), "embed", (7,)),
    versions={"torch": ("2.",)},
)


def test_a_layout_goes_to_json_and_back():
    assert from_json(PolicyLayout, json.loads(json.dumps(to_json(LAYOUT)))) == LAYOUT


@pytest.mark.parametrize(
    ("given", "count", "expected"),
    [((-3, None), 3, (0, 3)), ((-3, None), 20, (17, 20)), ((0, 5), 20, (0, 5)), ((-3, -1), 20, (17, 19))],
)
def test_action_queries_count_from_either_end(given, count, expected):
    assert replace(SITE, action_queries=given).queries(count) == expected


@pytest.mark.parametrize("given", [(-4, None), (0, 5), (3, None)])
def test_a_call_with_fewer_queries_is_refused(given):
    with pytest.raises(BadArgument, match="3 queries"):
        replace(SITE, action_queries=given).queries(3)


def test_rules_fit_whole_paths_and_their_conditions():
    rule = LAYOUT.rules[0]
    match = rule.fits("blocks.1.attention", "sdpa", 3, 13)
    assert match is not None
    assert match["block"] == "1"
    assert rule.fits("model.blocks.1.attention", "sdpa", 3, 13) is None
    assert rule.fits("blocks.1.attention", "sdpa", 4, 13) is None


def test_roles_of_masked_keys_follow_the_spans():
    assert [SITE.masked_role(span) for span in KEYS.spans] == [Role.MASKED_IMAGE, Role.PADDING, Role.ABSENT]
    assert SITE.role_of(KEYS.spans[1]) is Role.INSTRUCTION


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"rules": (CallRule("vision.*", None),)}, "'joint'"), ({"denoise_times": (1.0,)}, " 1 .* 4 ")],
)
def test_what_does_not_fit_is_said(changes, named):
    with pytest.raises(BadArgument, match=named):
        replace(LAYOUT, **changes)


def test_rules_and_sites_check_themselves():
    with pytest.raises(BadArgument, match=r"'\('"):
        CallRule("(", None)
    with pytest.raises(BadArgument, match=r"'blocks' .*'joint'"):
        CallRule("blocks", "joint")
    for call in (None, (None, 0), ("joint", None), ("joint",)):
        with pytest.raises(BadArgument, match="sequence"):
            CallRule("blocks", None, sequence=(("joint", 0), call))
    with pytest.raises(BadArgument, match="actions"):
        RecordedSite(KEYS, (0, 1), {"image_front": "image", "prompt": "text"})


@pytest.mark.parametrize(
    ("kind", "role"),
    [
        ("time", "learned"),
        ("learned", "learned"),
        ("states", "state"),
        ("state", "time"),
        ("state", "learnt"),
        ("latent", "learned"),
        ("image", "instruction"),
        (None, None),
    ],
)
def test_a_wrong_kind_or_role_shows_all_that_there_are_and_which_fit_together(kind, role):
    keys = SiteLayout("joint", (Span("clock", kind, 0, 1),))
    with pytest.raises(BadArgument) as caught:
        RecordedSite(keys, (0, 1), {"clock": role})
    said = str(caught.value)
    assert all(named in said for named in ("'clock'", f"'{kind}'", f"'{role}'"))
    with pytest.raises(BadArgument) as missing:
        RecordedSite(keys, (0, 1), {})
    for one, roles in ROLES_OF_KIND.items():
        assert f"{one} ({', '.join(known.label for known in roles)})" in str(missing.value)
        assert f"{one} ({', '.join(known.label for known in roles)})" in said


def test_the_guide_has_every_kind_with_its_roles():
    guide = (ROOT / "docs" / "my-policy.md").read_text(encoding="utf-8")
    table = guide.split("| kind | roles |")[1].split("\n\n")[0]
    rows = [re.findall(r"`(\w+)`", "|".join(row.split("|")[1:3])) for row in table.splitlines()[2:]]
    assert {kind: roles for kind, *roles in rows} == {
        kind: [role.label for role in roles] for kind, roles in ROLES_OF_KIND.items()
    }
