"""Recognise the ratio of the published Cosmos scripts: one latent frame over another."""

from __future__ import annotations

from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.selector_parser import Atom, parse_selector
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.results import FrameProxy
from vla_attention.schemas.stores.store_format import RootAttributes


def frame_proxy(root: RootAttributes, layout: SiteLayout, grouping: Grouping) -> FrameProxy | None:
    """The published ratio that a grouping asks for: one `frame:` selector on each side, at the site of the latent
    frames.

    None for every other ratio.
    """
    if grouping.ratio is None or not any(span.kind == "latent" for span in layout.spans):
        return None
    visual, text = (_frame_of(grouping, side) for side in (grouping.ratio.numerator, grouping.ratio.denominator))
    query = root.policy.config.get("query_frame")
    if visual is None or text is None or not isinstance(query, str):
        return None
    return FrameProxy(layout.num_keys, query, visual, text, root.recording.of_site(layout).num_action_queries)


def _frame_of(grouping: Grouping, side: tuple[str, ...]) -> str | None:
    selectors = [selector for name in side for selector in grouping.groups[name]]
    if len(selectors) != 1:
        return None
    tree = parse_selector(selectors[0])
    return tree.argument if isinstance(tree, Atom) and tree.kind == "frame" else None
