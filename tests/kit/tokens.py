"""Made-up token layouts, prompts, objects and attention rows: parts from which small episodes are built."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, ObjectKind, SceneObject
from vla_attention.schemas.layout import INVALID_ROLES, PatchGrid, Piece, Prompt, Role, SiteLayout, Span

#: One for each task, in turn.
INSTRUCTIONS = ("put the bowl on the plate", "open the top drawer", "turn on the stove")
OBJECTS = (
    SceneObject("akita_black_bowl_1", "object", True),
    SceneObject("plate_1", "object", True),
    SceneObject("wooden_cabinet_1", "fixture", False),
    SceneObject("robot", "robot", False),
    SceneObject("background", "background", False),
)
LIBERO_INSTRUCTION = "put both the alphabet soup and the tomato sauce in the basket"
_LIBERO_OBJECTS: dict[str, ObjectKind] = {
    "alphabet_soup_1": "object",
    "tomato_sauce_1": "object",
    "basket_1": "object",
    "cream_cheese_1": "object",
    "milk_1": "object",
    "robot": "robot",
    "background": "background",
}

#: The prompt of a replan, and the role of each key of the prompt's span, shape (key of the span,) uint8.
SpelledPrompt = tuple[Prompt, NDArray[np.uint8]]


def site_layout(
    grids: Mapping[str, tuple[int, int]], patch_pixels: int, text_keys: int, action_keys: int, state_keys: int = 0
) -> SiteLayout:
    """The site `joint`: cameras (name to rows and columns of patches), `prompt`, `state` if it has keys, `actions`."""
    lengths = [("prompt", "text", text_keys), ("state", "state", state_keys), ("actions", "action", action_keys)]
    spans: list[Span] = []
    start = 0
    for name, (rows, columns) in grids.items():
        grid = PatchGrid(rows, columns, rows * patch_pixels, columns * patch_pixels)
        spans.append(Span(name, "image", start, start + rows * columns, camera=name, grid=grid))
        start += rows * columns
    for name, kind, length in lengths:
        if length:
            spans.append(Span(name, kind, start, start + length))  # type: ignore[arg-type]
            start += length
    return SiteLayout("joint", tuple(spans))


def spell_prompt(layout: SiteLayout, texts: Iterable[tuple[str, Role]], instruction: str) -> SpelledPrompt:
    """A prompt of the given pieces, after bos; keys that are left over are padding."""
    span = layout.span("prompt")
    roles = np.full(span.num_keys, Role.PADDING, dtype=np.uint8)
    roles[0] = Role.BOS
    pieces: list[Piece] = []
    position = 0
    for i, (text, role) in enumerate(texts, start=1):
        pieces.append(Piece(span.start + i, text, position, position + len(text)))
        roles[i] = role
        position += len(text)
    prompt = "".join(piece.text for piece in pieces)
    first = prompt.index(instruction)
    return Prompt(prompt, tuple(pieces), (first, first + len(instruction))), roles


def tokens_of(
    layout: SiteLayout,
    prompts: Sequence[SpelledPrompt],
    objects: tuple[SceneObject, ...] = (),
    coverage: Mapping[str, NDArray[np.float32]] | None = None,
    masked: Sequence[str] = (),
) -> EpisodeTokens:
    """Tokens of an episode with one prompt per replan; `masked` cameras are masked out at every replan."""
    role_of_kind = {"image": Role.IMAGE, "text": Role.PADDING, "state": Role.STATE, "action": Role.ACTION}
    roles = np.zeros((len(prompts), layout.num_keys), dtype=np.uint8)
    for span in layout.spans:
        roles[:, span.start : span.stop] = Role.MASKED_IMAGE if span.camera in masked else role_of_kind[span.kind]
    text = layout.span("prompt")
    numbers: dict[Prompt, int] = {}
    index = []
    for replan, (prompt, text_roles) in enumerate(prompts):
        roles[replan, text.start : text.stop] = text_roles
        index.append(numbers.setdefault(prompt, len(numbers)))
    return EpisodeTokens(layout, roles, tuple(numbers), np.array(index), objects, coverage)


def small_layout(text_keys: int = 14) -> SiteLayout:
    """Two cameras, a masked one, a prompt, actions: 3 x 4 + 2 x 2 + 2 x 2 + 14 + 5 = 39 keys."""
    grids = {"base_0_rgb": (3, 4), "left_wrist_0_rgb": (2, 2), "right_wrist_0_rgb": (2, 2)}
    return site_layout(grids, patch_pixels=4, text_keys=text_keys, action_keys=5)


def small_prompt(layout: SiteLayout, instruction: str, digits: str) -> SpelledPrompt:
    """The prompt "instruction; digits", one piece a word."""
    words = [*((word, Role.INSTRUCTION) for word in instruction.split()), (";", Role.TEMPLATE)]
    words += [(digit, Role.STATE) for digit in digits.split()]
    texts = [(word if i == 0 or word == ";" else f" {word}", role) for i, (word, role) in enumerate(words)]
    return spell_prompt(layout, texts, instruction)


def small_tokens(replans: int, task: int, seed: Any, changing: bool = True) -> EpisodeTokens:
    """Tokens of an episode of `small_layout`; the state digits of a changing prompt differ in value and number."""
    layout = small_layout()
    generator = np.random.default_rng(seed)
    prompts = []
    for _ in range(replans):
        digits = " ".join(str(generator.integers(256)) for _ in range(generator.integers(1, 4) if changing else 2))
        digits = digits if changing else "12 250"
        prompts.append(small_prompt(layout, INSTRUCTIONS[task % len(INSTRUCTIONS)], digits))
    cameras = layout.cameras[:2]
    coverage = {camera: _random_coverage(generator, layout, camera, replans, len(OBJECTS), 0.3) for camera in cameras}
    return tokens_of(layout, prompts, OBJECTS, coverage, masked=("right_wrist_0_rgb",))


def libero_tokens(replans: int, seed: int = 0) -> EpisodeTokens:
    """Tokens as pi0.5 has them in LIBERO: three cameras of 16 x 16 patches (one masked), 200 prompt keys, ten actions.

    The prompt ends with the state's digits, which differ at every replan. Objects lie anywhere.
    """
    cameras = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
    layout = site_layout(dict.fromkeys(cameras, (16, 16)), patch_pixels=14, text_keys=200, action_keys=10)
    generator = np.random.default_rng(seed)
    prompts = []
    for _ in range(replans):
        words = [(word, Role.INSTRUCTION) for word in LIBERO_INSTRUCTION.split()]
        words += [(str(generator.integers(256)), Role.STATE) for _ in range(8)]
        texts = [(" " * (i > 0) + word, role) for i, (word, role) in enumerate(words)]
        prompts.append(spell_prompt(layout, texts, LIBERO_INSTRUCTION))
    objects = tuple(SceneObject(name, kind, i < 3) for i, (name, kind) in enumerate(_LIBERO_OBJECTS.items()))
    coverage = {
        camera: _random_coverage(generator, layout, camera, replans, len(objects), 0.2) for camera in cameras[:2]
    }
    return tokens_of(layout, prompts, objects, coverage, masked=cameras[2:])


def _random_coverage(
    generator: np.random.Generator, layout: SiteLayout, camera: str, replans: int, objects: int, evenness: float
) -> NDArray[np.float32]:
    """Area of each patch that each object covers, shape (replan, patch, object); the areas of a patch sum to 1."""
    patches = len(layout.patch_keys(camera))
    return generator.dirichlet(np.full(objects, evenness), (replans, patches)).astype(np.float32)


def valid_keys(key_role: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which keys can hold information, for role codes of any shape."""
    return ~np.isin(key_role, [int(role) for role in INVALID_ROLES])


def random_rows(tokens: EpisodeTokens, shape: tuple[int, ...], seed: int, spread: float = 3.0) -> NDArray[np.float32]:
    """Attention-like rows (replan, *shape, key): positive, exact zeros on keys that are not valid, summing to 1.

    `spread`: standard deviation of the logits; 0 gives uniform rows.
    """
    generator = np.random.default_rng(seed)
    logits = generator.normal(0, spread, (tokens.num_replans, *shape, tokens.layout.num_keys))
    valid = np.broadcast_to(tokens.valid, (tokens.num_replans, tokens.layout.num_keys))
    weights = np.exp(logits) * valid.reshape(tokens.num_replans, *(1,) * len(shape), -1)
    rows: NDArray[np.float32] = (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)
    return rows
