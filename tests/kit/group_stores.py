"""A realistic episode for tests of words, objects and groupings: two cameras of 16 x 16 patches, a two-piece word, moving objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.kit.store_kit import OBJECTS, StoreSpec, write_store
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb")
INSTRUCTION = "put the black bowl on the plate"


def layout(size: int = 16, image: int = 32) -> SiteLayout:
    """Cameras of size x size patches, 24 keys of prompt, 4 of actions."""
    spans = [
        Span(name, "image", i * size**2, (i + 1) * size**2, camera=name, grid=PatchGrid(size, size, image, image))
        for i, name in enumerate(CAMERAS)
    ]
    start = spans[-1].stop
    spans += [Span("prompt", "text", start, start + 24), Span("actions", "action", start + 24, start + 28)]
    return SiteLayout("joint", tuple(spans))


def prompt_of(site: SiteLayout, digits: tuple[str, ...], instruction: str = INSTRUCTION) -> tuple[Prompt, np.ndarray]:
    """State digits come first, so that the instruction's keys move with their number; 'bowl' is two pieces ('bo', 'wl')."""
    span = site.span("prompt")
    roles = np.full(span.num_keys, Role.PADDING, dtype=np.uint8)
    roles[0] = Role.BOS
    texts = [(f"{digit} ", Role.STATE) for digit in digits]
    for word in instruction.split():
        cut = [word[:2], word[2:]] if word == "bowl" else [word]
        texts += [(piece + (" " if i == len(cut) - 1 else ""), Role.INSTRUCTION) for i, piece in enumerate(cut)]
    pieces, position = [], 0
    for i, (text, role) in enumerate(texts):
        pieces.append(Piece(span.start + 1 + i, text, position, position + len(text)))
        roles[1 + i] = role
        position += len(text)
    text = "".join(piece.text for piece in pieces)
    first = text.index(instruction)
    return Prompt(text, tuple(pieces), (first, first + len(instruction))), roles


def episode_tokens(replans: int = 4, size: int = 16, instruction: str = INSTRUCTION) -> EpisodeTokens:
    """The bowl moves to the right from replan to replan and covers patches by parts; the prompt's length changes."""
    site = layout(size)
    roles = np.zeros((replans, site.num_keys), dtype=np.uint8)
    prompts, index = [], []
    for replan in range(replans):
        prompt, text_roles = prompt_of(site, tuple("12345"[: 1 + replan % 3]), instruction)
        if prompt not in prompts:
            prompts.append(prompt)
        index.append(prompts.index(prompt))
        for span in site.spans:
            kind = {"image": Role.IMAGE, "action": Role.ACTION, "text": Role.PADDING}[span.kind]
            roles[replan, span.start : span.stop] = kind
        span = site.span("prompt")
        roles[replan, span.start : span.stop] = text_roles
    return EpisodeTokens(site, roles, tuple(prompts), np.array(index), OBJECTS, coverage_of(replans, size))


def coverage_of(replans: int, size: int) -> dict[str, np.ndarray]:
    """(replan, patch, object) of each camera: bowl, plate, cabinet, robot, background."""
    coverage = {}
    for shift, camera in enumerate(CAMERAS):
        area = np.zeros((replans, size, size, len(OBJECTS)), dtype=np.float32)
        area[:, :3, size // 2 :, 3] = 1.0
        area[:, size - 3 :, : size // 2, 2] = 1.0
        area[:, size // 2, size - 3 : size - 1, 1] = 0.75
        for replan in range(replans):
            column = 1 + shift + replan % (size - 6)
            area[replan, 4:6, column] = [0.625, 0, 0, 0, 0]
            area[replan, 4:6, column + 1] = [1, 0, 0, 0, 0]
        area[..., 4] = 1.0 - area[..., :4].sum(axis=-1)
        coverage[camera] = area.reshape(replans, size * size, len(OBJECTS))
    return coverage


def write(path: Path, **changes) -> Path:
    """A store of such episodes; further fields of the `StoreSpec` may be changed."""
    spec = {"tokens": episode_tokens(), "tasks": (0, 1), "episodes": 2, "layers": (0, 2, 3), "heads": (0, 1)}
    return write_store(path, spec=StoreSpec(**{**spec, **changes}))


def random_rows(tokens: EpisodeTokens, shape: tuple[int, ...], seed: int, spread: float = 0.5) -> np.ndarray:
    """Rows (replan, *shape, key) near uniform over the valid keys, positive, not normalised."""
    generator = np.random.default_rng(seed)
    valid = np.broadcast_to(tokens.valid, (tokens.num_replans, tokens.layout.num_keys))
    noise = np.exp(generator.normal(0, spread, (tokens.num_replans, *shape, tokens.layout.num_keys)))
    return noise * valid.reshape(tokens.num_replans, *(1,) * len(shape), -1)
