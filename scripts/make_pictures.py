"""Draw the pictures of `docs/reading.md` and `docs/effects.md`, with the tool's own commands.

Those of `docs/reading.md` are of made-up rows with a known truth, `moves` is of the example store.

Usage: python scripts/make_pictures.py [--folder docs/pictures]
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import vla_attention as va
from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import libero_tokens
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role

#: Task 0 ignores content, task 1 looks (patches get four times as much as words), task 2 reads (the reverse).
FAVOURS = {0: 1.0, 1: 4.0, 2: 0.25}
SINK_PATCH = (2, 13)
SINK_SHARE = 1 / 3
SPECIALIST = (9, 3)


def nearly_uniform(tokens: EpisodeTokens, shape: tuple[int, ...], seed: list[int], spread: float = 0.4) -> np.ndarray:
    """Weights (replan, *shape, key) of log-normal noise around equal attention to every valid key, not normalised."""
    generator = np.random.default_rng(seed)
    noise = np.exp(spread * generator.normal(size=(tokens.num_replans, *shape, tokens.layout.num_keys)))
    level = np.exp(0.25 * generator.normal())  # episodes differ
    text = is_text(tokens)[:, None, None, None, None]
    return noise * np.where(text, level, 1.0) * tokens.valid[:, None, None, None, None]


def is_text(tokens: EpisodeTokens) -> np.ndarray:
    """Keys of bos and instruction, shape (replan or 1, key)."""
    return np.isin(tokens.static_roles, [Role.BOS, Role.INSTRUCTION])


def normalised(weights: np.ndarray) -> np.ndarray:
    return weights / weights.sum(axis=-1, keepdims=True)


def favour(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    weights = nearly_uniform(tokens, rows.shape[1:-1], [1, task, episode])
    image = (tokens.static_roles == Role.IMAGE)[:, None, None, None, None]
    return normalised(weights * np.where(image, FAVOURS[task], 1.0))


def sink(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    made = normalised(nearly_uniform(tokens, rows.shape[1:-1], [2, task, episode]))
    key = SINK_PATCH[0] * 16 + SINK_PATCH[1]
    made[..., key] = 0.0
    made *= (1.0 - SINK_SHARE) / made.sum(axis=-1, keepdims=True)
    made[..., key] = SINK_SHARE
    return made


def specialist(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    weights = nearly_uniform(tokens, rows.shape[1:-1], [3, task, episode])
    layer, head = SPECIALIST
    text = np.broadcast_to(is_text(tokens)[:, None, None], weights[:, layer, :, head].shape)
    weights[:, layer, :, head] *= np.where(text, 40.0, 1.0)
    return normalised(weights)


SINK = ["overlay", "--cameras", "base_0_rgb", "--episode", "0"]


def draw(name: str, store: Path, command: list[str], picture: str | None, scratch: Path, folder: Path) -> None:
    """Run a command on a store and keep one of its pictures (None: its only one) as NAME.png."""
    if analyze([command[0], str(store), *command[1:], "--output", str(scratch)]):
        raise SystemExit(f"{name}: the analysis failed")
    drawn = scratch / f"{picture}.png" if picture else next(scratch.rglob("*.png"))
    shutil.copyfile(drawn, folder / f"{name}.png")
    print(folder / f"{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path(__file__).resolve().parents[1] / "docs/pictures")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix="pictures_"))
    shape = StoreSpec(
        tokens=libero_tokens(6),
        num_layers=18,
        layers=tuple(range(18)),
        heads=tuple(range(8)),
        frames=False,
        coverage=False,
    )
    cases = {
        "baseline": (favour, {"layers": (0, 9, 17), "tasks": (0, 1, 2), "episodes": 6}, ["analyze"], "ratio_per_task"),
        "sink": (sink, {"layers": (9,), "tasks": (0,), "episodes": 2}, SINK, None),
        "specialist_head": (
            specialist,
            {"tasks": (0, 1), "episodes": 3},
            ["analyze", "--by", "layer,head"],
            "by_layer_head",
        ),
    }
    for name, (plant, changes, command, picture) in cases.items():
        store = write_store(scratch / f"{name}.zarr", spec=shape, plant_rows=plant, suite="made_up", **changes)
        draw(name, store, command, picture, scratch / name, folder)
    store = scratch / "moves.zarr"
    words = ["rerun", str(va.example("cubes")), "--effects", "map:8x8", "--task", "0", "--num-episodes", "1"]
    if capture([*words, "--output", str(store)]):
        raise SystemExit("moves: the rerun failed")
    command = ["overlay", "--episode", "0", "--cameras", "base_0_rgb"]
    draw("moves", store, command, None, scratch / "moves", folder)
    shutil.rmtree(scratch)


if __name__ == "__main__":
    main()
