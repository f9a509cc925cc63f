"""Hypothesis strategies: random layouts, tokens and groupings, all of them valid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from tests.kit.tokens import SpelledPrompt, spell_prompt, tokens_of
from vla_attention.schemas.fitted_pictures import border_of_keys, with_borders
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, ObjectKind, SceneObject
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout, Span, SpanKind

NOUNS = ("bowl", "plate", "drawer", "stove", "mug")
#: Parts of its picture that a span of a camera covers; None: a token that lies nowhere in it.
PARTS = ((0.0, 0.0, 1.0, 1.0), (0.0, 0.5, 0.5, 0.5), (0.5, 0.0, 0.5, 1.0), (1 / 3, 0.125, 1 / 3, 0.5), None)
#: Parts of a camera's frame that show its picture; None: all of it.
SHOWN = (None, None, (0.125, 0.0, 0.75, 1.0), (0.0, 0.3, 1.0, 0.4), (0.25, 0.0, 0.5, 1.0))
OBJECTS: dict[str, ObjectKind] = {
    "bowl_1": "object",
    "plate_1": "object",
    "robot": "robot",
    "background": "background",
}


@st.composite
def layouts(draw: st.DrawFn) -> SiteLayout:
    """One to three cameras of one to four spans each, a prompt, perhaps a state token, actions; in any order.

    The first span of a camera has a grid over the whole picture. Others have one, or a tile, or are pooled tokens.
    """
    parts: list[tuple[str, SpanKind, int, str | None, PatchGrid | None]] = []
    for i in range(draw(st.integers(1, 3))):
        for j in range(draw(st.sampled_from([1, 1, 2, 3, 4]))):
            part = draw(st.sampled_from(PARTS)) if j else PARTS[0]
            rows, columns = draw(st.integers(1, 4)), draw(st.integers(1, 4))
            grid = None if part is None else PatchGrid(rows, columns, 48, 64, part)
            parts.append((f"camera{i}_{j}", "image", 1 if grid is None else rows * columns, f"camera{i}", grid))
    lengths = {"prompt": draw(st.integers(8, 14)), "state": draw(st.integers(0, 1)), "actions": draw(st.integers(1, 4))}
    kinds: dict[str, SpanKind] = {"prompt": "text", "state": "state", "actions": "action"}
    parts += [(name, kinds[name], length, None, None) for name, length in lengths.items() if length]
    spans, start = [], 0
    for name, kind, length, camera, grid in draw(st.permutations(parts)) if draw(st.booleans()) else parts:
        spans.append(Span(name, kind, start, start + length, camera, grid))
        start += length
    return SiteLayout("joint", tuple(spans))


@st.composite
def episode_tokens(draw: st.DrawFn, fitted: bool = False) -> EpisodeTokens:
    """Tokens of an episode: a masked camera perhaps, prompts that may change between replans, objects on patches.

    fitted: pictures may have a border.
    """
    layout = draw(layouts())
    replans = draw(st.integers(1, 4))
    choices = [draw(prompts_for(layout)) for _ in range(draw(st.integers(1, min(2, replans))))]
    prompts = [draw(st.sampled_from(choices)) for _ in range(replans)]
    masked = ("camera1",) if draw(st.booleans()) else ()
    objects = tuple(SceneObject(name, kind, name == "bowl_1") for name, kind in OBJECTS.items())
    coverage = {}
    for camera in layout.cameras:
        if camera not in masked:
            seed = draw(st.integers(0, 2**16))
            patches = len(layout.patch_keys(camera))
            share = np.random.default_rng(seed).dirichlet(np.full(len(objects), 0.4), size=(replans, patches))
            coverage[camera] = share.astype(np.float32)
    tokens = tokens_of(layout, prompts, objects, coverage, masked)
    if not fitted:
        return tokens
    shown = {camera: part for camera in coverage if (part := draw(st.sampled_from(SHOWN))) is not None}
    roles = np.stack([with_borders(layout, of_replan, shown) for of_replan in tokens.key_role])
    return replace(tokens, key_role=roles, border=border_of_keys(layout, shown))


@st.composite
def prompts_for(draw: st.DrawFn, layout: SiteLayout) -> SpelledPrompt:
    """An instruction of two to four words, one or two pieces a word, between bos and a line end."""
    words = draw(st.lists(st.sampled_from(NOUNS), min_size=2, max_size=4))
    texts: list[str] = []
    for i, word in enumerate(words):
        text = " " * (i > 0) + word  # a piece carries the space before its word
        cut = draw(st.sampled_from([len(text), 2 + (i > 0)])) if len(texts) < 3 else len(text)
        texts += [part for part in (text[:cut], text[cut:]) if part]
    pieces = [*((text, Role.INSTRUCTION) for text in texts), ("\n", Role.TEMPLATE)]
    return spell_prompt(layout, pieces, " ".join(words))


@st.composite
def groupings(draw: st.DrawFn, tokens: EpisodeTokens) -> Grouping:
    """A disjoint, complete grouping: later groups give up what earlier ones took; the last one is the rest."""
    cameras = tokens.layout.cameras
    grids = tokens.layout.grids(cameras[0])
    ends: list[float] = [draw(st.integers(1, grids[0].rows)), draw(st.integers(1, grids[0].columns))]
    if len(grids) > 1:
        ends = [end / whole for end, whole in zip(ends, (grids[0].rows, grids[0].columns), strict=True)]
    assert tokens.prompt_index is not None
    choices = [
        *(f"camera:{camera}" for camera in cameras),
        *(f"role:{role}" for role in ("image", "border", "instruction", "template", "action", "padding", "state")),
        *(f"span:{span.name}" for span in tokens.layout.spans),
        *(f"word:{word}" for word in sorted({word.text for i in set(tokens.prompt_index) for word in tokens.words[i]})),
        *(f"object:{name}" for name in (*OBJECTS, "@interest", "@robot", "@background")),
        f"patch:{cameras[0]}[0:{ends[0]},0:{ends[1]}]",
        f"keys:0-{draw(st.integers(0, tokens.layout.num_keys - 1))}",
    ]
    atoms = draw(st.lists(st.sampled_from(choices), min_size=1, max_size=4, unique=True))
    groups: dict[str, tuple[str, ...]] = {}
    for i, atom in enumerate(atoms):
        operand = draw(st.sampled_from(choices))
        wanted = draw(st.sampled_from([atom, f"{atom} | {operand}", f"{atom} & {operand}", f"({atom} | {operand})"]))
        earlier = " | ".join(f"({selector})" for (selector,) in groups.values())
        groups[f"g{i}"] = (f"({wanted}) - ({earlier})" if earlier else wanted,)
    groups["rest"] = ("*",)
    return Grouping("random", groups, allow_empty=tuple(groups))
