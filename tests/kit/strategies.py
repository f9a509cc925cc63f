"""Hypothesis strategies: random layouts, tokens, rows and groupings, all of them valid."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span

NOUNS = ("bowl", "plate", "drawer", "stove", "mug")
OBJECTS = ("bowl_1", "plate_1", "robot", "background")


@st.composite
def layouts(draw: st.DrawFn) -> SiteLayout:
    """One to three cameras of different grids, a prompt, perhaps a state token, actions."""
    spans: list[Span] = []
    start = 0

    def add(name: str, kind: str, length: int, **more: object) -> None:
        nonlocal start
        spans.append(Span(name, kind, start, start + length, **more))  # type: ignore[arg-type]
        start += length

    for i in range(draw(st.integers(1, 3))):
        rows, columns = draw(st.integers(1, 4)), draw(st.integers(1, 4))
        grid = PatchGrid(rows, columns, rows * 14, columns * 14)
        add(f"camera{i}", "image", rows * columns, camera=f"camera{i}", grid=grid)
    add("prompt", "text", draw(st.integers(8, 14)))
    if draw(st.booleans()):
        add("state", "state", 1)
    add("actions", "action", draw(st.integers(1, 4)))
    return SiteLayout("joint", tuple(spans))


@st.composite
def episode_tokens(draw: st.DrawFn) -> EpisodeTokens:
    """Tokens of an episode: a masked camera perhaps, prompts that may change between replans, objects on patches."""
    layout = draw(layouts())
    replans = draw(st.integers(1, 4))
    prompts = tuple(draw(prompts_for(layout)) for _ in range(draw(st.integers(1, min(2, replans)))))
    index = np.array([draw(st.integers(0, len(prompts) - 1)) for _ in range(replans)])
    roles = np.zeros((replans, layout.num_keys), dtype=np.uint8)
    masked = draw(st.booleans())
    for span in layout.spans:
        role = {"image": Role.IMAGE, "text": Role.PADDING, "state": Role.STATE, "action": Role.ACTION}[span.kind]
        if span.name == "camera1" and masked:
            role = Role.MASKED_IMAGE
        roles[:, span.start : span.stop] = role
    first = layout.span("prompt").start
    for replan, which in enumerate(index):
        roles[replan, first] = Role.BOS
        for piece in prompts[which].pieces:
            roles[replan, piece.key] = Role.INSTRUCTION
        roles[replan, max(piece.key for piece in prompts[which].pieces) + 1] = Role.TEMPLATE
    objects = tuple(
        SceneObject(name, {"robot": "robot", "background": "background"}.get(name, "object"), name == "bowl_1")  # type: ignore[arg-type]
        for name in OBJECTS
    )
    coverage = {}
    for span in layout.spans:
        if span.kind == "image" and not (masked and span.name == "camera1"):
            seed = draw(st.integers(0, 2**16))
            share = np.random.default_rng(seed).dirichlet(np.full(len(objects), 0.4), size=(replans, span.num_keys))
            coverage[span.name] = share.astype(np.float32)
    return EpisodeTokens(layout, roles, prompts, index, objects, coverage)


@st.composite
def prompts_for(draw: st.DrawFn, layout: SiteLayout) -> Prompt:
    """An instruction of two to four words, one or two pieces a word, after the bos key."""
    words = draw(st.lists(st.sampled_from(NOUNS), min_size=2, max_size=4))
    text = " ".join(words) + "\n"
    pieces: list[Piece] = []
    key, position = layout.span("prompt").start + 1, 0
    for i, word in enumerate(words):
        start, stop = position - (i > 0), position + len(word)  # a piece carries the space before its word
        cut = draw(st.sampled_from([stop, position + 2])) if len(pieces) < 3 else stop
        for a, b in ((start, cut), (cut, stop)):
            if a < b:
                pieces.append(Piece(key, text[a:b], a, b))
                key += 1
        position = stop + 1
    return Prompt(text, tuple(pieces), (0, len(text) - 1))


def random_rows(tokens: EpisodeTokens, shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Attention-like rows (replan, *shape, key) float32: positive, exact zeros on keys that are not valid, summing to 1."""
    generator = np.random.default_rng(seed)
    logits = generator.normal(0, 3, (tokens.num_replans, *shape, tokens.layout.num_keys))
    valid = np.broadcast_to(tokens.valid, (tokens.num_replans, tokens.layout.num_keys))
    weights = np.exp(logits) * valid.reshape(tokens.num_replans, *(1,) * len(shape), -1)
    return (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)


@st.composite
def groupings(draw: st.DrawFn, tokens: EpisodeTokens) -> Grouping:
    """A disjoint, complete grouping: later groups give up what earlier ones took; the last one is the rest."""
    cameras = tokens.layout.cameras
    grid = tokens.layout.camera_span(cameras[0]).grid
    assert grid is not None
    assert tokens.prompt_index is not None
    choices = [
        *(f"camera:{camera}" for camera in cameras),
        *(f"role:{role}" for role in ("image", "instruction", "template", "action", "padding", "state")),
        *(f"span:{span.name}" for span in tokens.layout.spans),
        *(f"word:{word}" for word in sorted({word.text for i in set(tokens.prompt_index) for word in tokens.words[i]})),
        *(f"object:{name}" for name in (*OBJECTS, "@interest", "@robot", "@background")),
        f"patch:{cameras[0]}[0:{draw(st.integers(1, grid.rows))},0:{draw(st.integers(1, grid.columns))}]",
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
