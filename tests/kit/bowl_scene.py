"""An episode for tests of words, objects and groupings: cameras of 16 x 16 patches, a two-piece word, a moving bowl."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import OBJECTS, SpelledPrompt, site_layout, spell_prompt, tokens_of
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role, SiteLayout

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb")
INSTRUCTION = "put the black bowl on the plate"


def bowl_prompt(site: SiteLayout, digits: tuple[str, ...], instruction: str = INSTRUCTION) -> SpelledPrompt:
    """State digits stand before the instruction, so that its keys move; 'bowl' is two pieces, 'bo' and 'wl'."""
    texts = [(f"{digit} ", Role.STATE) for digit in digits]
    for word in instruction.split():
        cut = [word[:2], word[2:]] if word == "bowl" else [word]
        texts += [(piece + " " * (i == len(cut) - 1), Role.INSTRUCTION) for i, piece in enumerate(cut)]
    return spell_prompt(site, texts, instruction)


def bowl_tokens(replans: int = 4, size: int = 16, instruction: str = INSTRUCTION) -> EpisodeTokens:
    """The bowl moves to the right from replan to replan and covers patches by parts; the prompt's length changes."""
    site = site_layout(dict.fromkeys(CAMERAS, (size, size)), 32 // size, text_keys=24, action_keys=4)
    prompts = [bowl_prompt(site, tuple("12345"[: 1 + replan % 3]), instruction) for replan in range(replans)]
    return tokens_of(site, prompts, OBJECTS, bowl_coverage(replans, size))


def bowl_coverage(replans: int, size: int) -> dict[str, np.ndarray]:
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


def write_bowl_store(path: Path, **changes) -> Path:
    """A store of such episodes; further fields of the `StoreSpec` may be changed."""
    spec = {"tokens": bowl_tokens(), "tasks": (0, 1), "episodes": 2, "layers": (0, 2, 3), "heads": (0, 1)}
    return write_store(path, spec=StoreSpec(**{**spec, **changes}))
