"""Made-up episodes of all kinds of policies, for groupings: see `grouping_cases`."""
# ruff: noqa: RUF001 - letters that look like others are meant

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tests.kit.tokens import libero_tokens, small_tokens
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, ObjectKind, SceneObject
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span

#: Episodes of different layouts, prompts and scenes.
NUM_EPISODES = 30
_INSTRUCTIONS = (
    "put the bowl on the plate",
    "Open the TOP drawer and the top-left drawer",
    "pick_up the_black bowl",
    "straße und STRASSE, naïve-café",
    "stack 3 cubes: don't touch the robot’s arm",
    "🤖 move the ﬁrst İstanbul mug",
    "ǅungla Σίσυφος ΌΣΟΣ",
)
#: Parts of a picture that further spans of a camera cover; None: a pooled token.
_SIDES = ((0.0, 0.0, 1.0, 1.0), (0.0, 0.5, 0.5, 0.5), (1 / 3, 0.1, 1 / 3, 0.6), None)
_Part = tuple[str, str, int, PatchGrid | None, bool]


def made_up_episode(seed: int, number: int) -> EpisodeTokens:
    """The tokens of one episode; `number` decides its kind."""
    generator = np.random.default_rng([seed, 2, number])
    kind = number % 6
    if kind == 0:
        return small_tokens(int(generator.integers(1, 4)), task=number, seed=[seed, number])
    if number == 1:
        return libero_tokens(2, seed)
    if kind == 1:
        return _cosmos(generator)
    layout = _layout(generator, growing=kind in (2, 3), latent=False, joint=number % 2 == 0, several=number % 5 > 2)
    absent = Role.ABSENT if kind in (2, 4) else Role.PADDING
    return _tokens(generator, layout, absent, _num_objects(generator, number))


def _num_objects(generator: np.random.Generator, number: int) -> int:
    # Numbers around those at which numpy adds in another order.
    return int(generator.choice([0, 1, 5, 7, 8, 12, 20])) if number % 11 else 150


def _layout(
    generator: np.random.Generator, *, growing: bool, latent: bool, joint: bool, several: bool = False
) -> SiteLayout:
    parts: list[_Part] = []
    if latent:
        grid = PatchGrid(2, 3, 8, 12)
        parts = [("blank", "latent", 6, None, False)]
        parts += [(name, "latent", 6, grid, False) for name in ("proprio", "wrist", "primary")]
        parts += [("action", "latent", 6, None, False), ("future primary", "latent", 6, None, False)]
    else:
        for i in range(int(generator.integers(1, 4))):
            rows, columns = (int(n) for n in generator.integers(1, 5, 2))
            name = str(generator.choice(["base_0_rgb", "left wrist", "cam(é)", "camera"])) + f"{i or ''}"
            whole = PatchGrid(rows, columns, 48, 64)
            parts.append((name, "image", rows * columns, whole, False))
            for j in range(int(generator.integers(0, 4)) if several else 0):  # tiles, other grids, and pooled tokens
                part = _SIDES[int(generator.integers(0, len(_SIDES)))]
                grid = None if part is None else PatchGrid(rows, 2, 48, 64, part)
                parts.append((f"{name}#{j}", "image", 2 if part is None else 2 * rows, grid, False))
        if several:  # a camera's spans need not follow each other
            parts = [parts[int(i)] for i in generator.permutation(len(parts))]
        parts.append(("prompt", "text", int(generator.integers(12, 20)), None, False))
        if joint:
            parts += [("state", "state", 1, None, False), ("actions", "action", 4, None, False)]
        if growing:
            parts.append(("generated", "action", 5, None, True))
    spans, start = [], 0
    offset = int(generator.integers(0, 3))
    for name, kind, length, grid, grows in parts:
        seen = kind == "image" or (grid is not None and name != "proprio")
        camera = name.partition("#")[0] if seen else None
        own = grid if camera is not None else None
        spans.append(
            Span(name, kind, start, start + length, camera, own, grows, offset if grows else 0)  # type: ignore[arg-type]
        )
        start += length
    return SiteLayout("joint" if joint else "self", tuple(spans))


def _cosmos(generator: np.random.Generator) -> EpisodeTokens:
    """Latent frames: pictures, numbers and noise; no words."""
    layout = _layout(generator, growing=False, latent=True, joint=False)
    roles = {"blank": Role.BLANK, "proprio": Role.PROPRIO, "action": Role.ACTION, "future primary": Role.FUTURE}
    replans = int(generator.integers(1, 3))
    key_role = np.zeros((replans, layout.num_keys), dtype=np.uint8)
    for span in layout.spans:
        key_role[:, span.start : span.stop] = roles.get(span.name, Role.IMAGE)
    objects = _objects(9)
    return EpisodeTokens(layout, key_role, objects=objects, coverage=_coverage(generator, layout, replans, objects, ()))


def _tokens(generator: np.random.Generator, layout: SiteLayout, absent: Role, num_objects: int) -> EpisodeTokens:
    replans = int(generator.integers(1, 5))
    of_kind = {"image": Role.IMAGE, "state": Role.PROPRIO, "action": Role.ACTION}
    key_role = np.zeros((replans, layout.num_keys), dtype=np.uint8)
    for span in layout.spans:
        key_role[:, span.start : span.stop] = of_kind.get(span.kind, absent)
        if span.growing:
            for replan in range(replans):
                missing = int(generator.integers(0, span.num_keys + 1))
                key_role[replan, span.stop - missing : span.stop] = Role.ABSENT
    masked = layout.cameras[1:2] if generator.random() < 0.4 else ()
    for camera in masked:
        for span in layout.camera_spans(camera):
            key_role[:, span.start : span.stop] = Role.MASKED_IMAGE
    choices = [str(text) for text in generator.choice(_INSTRUCTIONS, 2)]
    prompts: list[Prompt] = []
    index = []
    for replan in range(replans):
        prompt = _prompt(generator, layout.span("prompt"), choices[int(generator.integers(0, 2))], key_role[replan])
        if prompt not in prompts:
            prompts.append(prompt)
        index.append(prompts.index(prompt))
    objects = _objects(num_objects)
    return EpisodeTokens(
        layout,
        key_role,
        tuple(prompts),
        np.array(index),
        objects,
        _coverage(generator, layout, replans, objects, masked) if objects else None,
    )


def _prompt(generator: np.random.Generator, span: Span, instruction: str, roles: NDArray[np.uint8]) -> Prompt:
    """Bos, "Task: ", pieces of a few characters (a piece may reach into two words), and state digits."""
    text = f"Task: {instruction}; {generator.integers(0, 300)}"
    first = len("Task: ")
    cuts = [0, first]
    while cuts[-1] < len(text) and len(cuts) < span.num_keys:
        cuts.append(min(len(text), cuts[-1] + int(generator.integers(2, 7))))
    roles[span.start] = Role.BOS
    pieces = []
    for i, (start, stop) in enumerate(itertools.pairwise(cuts), start=1):
        pieces.append(Piece(span.start + i, text[start:stop], start, stop))
        inside = start < first + len(instruction) and stop > first
        roles[span.start + i] = Role.INSTRUCTION if inside else Role.TEMPLATE if start < first else Role.STATE
    return Prompt(text, tuple(pieces), (first, first + len(instruction)))


def _objects(count: int) -> tuple[SceneObject, ...]:
    kinds: Sequence[ObjectKind] = ("object", "robot", "background", "fixture")
    names = ("plate_1", "robot", "background", "wooden_cabinet_1")
    return tuple(
        SceneObject(names[i] if i < 4 else f"thing_{i}", kinds[i] if i < 4 else "object", i in (0, 5))
        for i in range(count)
    )


def _coverage(
    generator: np.random.Generator,
    layout: SiteLayout,
    replans: int,
    objects: tuple[SceneObject, ...],
    without: Sequence[str],
) -> dict[str, NDArray[np.float32]]:
    """Covered areas; some patches are covered in part only."""
    coverage = {}
    for camera in layout.pictured:
        if camera not in without:
            shape = (replans, len(layout.patch_keys(camera)))
            share = generator.dirichlet(np.full(len(objects), 0.4), size=shape)
            coverage[camera] = (share * generator.choice([1.0, 0.6], (*shape, 1))).astype(np.float32)
    return coverage
