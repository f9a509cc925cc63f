"""When a ratio is the published Cosmos scripts' own: one latent frame over another, and nothing else."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from tests.kit.stores import StoreSpec, root_attributes
from vla_attention.analyze.published.results_writer import frame_proxy
from vla_attention.schemas.groupings.builtin_groupings import BUILTIN_GROUPINGS
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.groupings.vocabulary import Vocabulary
from vla_attention.schemas.layout import SiteLayout, Span
from vla_attention.schemas.results import FrameProxy

FRAMES = ("blank", "proprio", "wrist", "primary", "action")
SELF = SiteLayout(
    "self",
    tuple(
        Span(name, "latent", 4 * i, 4 * i + 4, camera=name if name in ("wrist", "primary") else None)
        for i, name in enumerate(FRAMES)
    ),
)


def root(**config):
    made = root_attributes(StoreSpec(num_action_queries=4))
    return replace(made, policy=replace(made.policy, config={"query_frame": "action", **config}))


def grouping(above: tuple[str, ...], below: tuple[str, ...], **more: tuple[str, ...]) -> Grouping:
    return Grouping("g", {"a": above, "b": below, **more}, Ratio(("a",), ("b",)))


def test_one_frame_over_another_is_named_as_it_was_typed():
    found = frame_proxy(root(), SELF, grouping(("frame:curr_last",), ("frame:frame0",), rest=("*",)))
    assert found == FrameProxy(20, "action", "curr_last", "frame0", num_queries=4)
    assert found.fields() == {
        "selected_call_S": 20,
        "query_frame": "action",
        "visual_frame": "curr_last",
        "text_frame": "frame0",
    }


def test_the_grouping_reference_is_one():
    vocabulary = Vocabulary(SELF, ("wrist", "primary"), ("image", "blank"), (), ())
    found = frame_proxy(root(query_frame="primary"), SELF, BUILTIN_GROUPINGS["reference"](vocabulary))
    assert found == FrameProxy(20, "primary", "curr_last", "frame0", num_queries=4)


@pytest.mark.parametrize(
    ("above", "below"),
    [
        (("frame:wrist", "frame:primary"), ("frame:blank",)),
        (("frame:wrist | frame:primary",), ("frame:blank",)),
        (("frame:primary",), ("role:blank",)),
        (("camera:primary",), ("frame:blank",)),
        (("frame:primary",), ("frame:blank & role:blank",)),
    ],
)
def test_anything_else_is_not(above, below):
    assert frame_proxy(root(), SELF, grouping(above, below)) is None
