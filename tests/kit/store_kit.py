"""Small stores with known content, written by the real writer: `write_store(tmp_path / "a.zarr", tasks=(0, 2), episodes=3)`.

What a store must contain is recomputed from its `StoreSpec` with `episode_records`; nothing is random but by the spec's seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tests.kit.strategies import random_rows
from vla_attention.capture.store.episode_writer import EpisodeStart, EpisodeWriter, ReplanRecord
from vla_attention.capture.store.recorded_rows import RecordedRows
from vla_attention.capture.store.store_writer import RunStore, WriteMode, open_run
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject
from vla_attention.schemas.layout import INVALID_ROLES, PatchGrid, Piece, Prompt, Role, SiteLayout, Span
from vla_attention.schemas.segments import segments_of
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    FORMAT_VERSION,
    PolicyCameraView,
    PolicyIdentity,
    Protocol,
    Recording,
    RootAttributes,
)

#: One for each task, in turn.
INSTRUCTIONS = ("put the bowl on the plate", "open the top drawer", "turn on the stove")
OBJECTS = (
    SceneObject("akita_black_bowl_1", "object", True),
    SceneObject("plate_1", "object", True),
    SceneObject("wooden_cabinet_1", "fixture", False),
    SceneObject("robot", "robot", False),
    SceneObject("background", "background", False),
)


@dataclass(frozen=True)
class StoreSpec:
    """What a made-up store holds.

    Every episode has `replans` replans. `tokens`, when given, are the tokens of every episode (and decide the number of
    replans); otherwise each episode has those of `make_tokens`. `prompts`: "changing" (state digits, as in pi0.5) or "same".
    """

    suite: str = "made_up"
    tasks: tuple[int, ...] = (0, 1)
    episodes: int = 2
    replans: int = 3
    seed: int = 0
    layers: tuple[int, ...] = (0, 2)
    layer_labels: tuple[int, ...] | None = None
    num_layers: int = 4
    denoise_steps: tuple[int, ...] = (0, 9)
    heads: tuple[int, ...] = (0, 1)
    queries: Literal["mean", "all"] = "mean"
    num_action_queries: int = 3
    mantissa_bits: int = 10
    frames: bool = True
    contributions: bool = False
    coverage: bool = True
    prompts: Literal["changing", "same"] = "changing"
    policy: str = "made-up"
    tokens: EpisodeTokens | None = None
    plant_rows: Callable[[int, int, EpisodeTokens, np.ndarray], np.ndarray] | None = None
    plant_actions: Callable[[int, int, int], np.ndarray] | None = None
    plant_success: Callable[[int, int], bool] | None = None

    @property
    def layout(self) -> SiteLayout:
        return small_layout() if self.tokens is None else self.tokens.layout

    @property
    def num_replans(self) -> int:
        return self.replans if self.tokens is None else self.tokens.num_replans

    @property
    def cells(self) -> tuple[int, int, int, int]:
        """(layer, denoise, head, query)."""
        queries = 1 if self.queries == "mean" else self.num_action_queries
        return (len(self.layers), len(self.denoise_steps), len(self.heads), queries)

    @property
    def names(self) -> list[tuple[int, int]]:
        """(task, episode) of every episode."""
        return [(task, episode) for task in self.tasks for episode in range(self.episodes)]


def write_store(path: Path, *, mode: WriteMode = "new", spec: StoreSpec | None = None, **changes: Any) -> Path:
    """Write a store with every episode of a spec, or of the default one with some fields changed; returns its path."""
    spec = replace(spec or StoreSpec(), **changes)
    store = open_run(path, root_attributes(spec), mode)
    for task, episode in spec.names:
        if (task, episode) not in store.committed():
            write_episode(store, spec, task, episode)
    return path


def write_episode(store: RunStore, spec: StoreSpec, task: int, episode: int) -> Path:
    """Write and commit one episode."""
    start, records = episode_records(spec, task, episode)
    with store.episode(start, denoise_times(spec), len(records)) as writer:
        for record in records:
            writer.append(record)
        return commit(writer, spec, task, episode)


def commit(writer: EpisodeWriter, spec: StoreSpec, task: int, episode: int) -> Path:
    """Commit with the outcome that belongs to the episode: unless planted, those of odd numbers are solved."""
    success = spec.plant_success(task, episode) if spec.plant_success else episode % 2 == 1
    return writer.commit(success=success, num_steps=5 * spec.num_replans - episode % 2)


def denoise_times(spec: StoreSpec) -> np.ndarray:
    return 1.0 - np.array(spec.denoise_steps) / 10


def root_attributes(spec: StoreSpec) -> RootAttributes:
    cameras = tuple(PolicyCameraView(name, f"{name}_image", True, False) for name in spec.layout.cameras)
    return RootAttributes(
        format=FORMAT_NAME,
        format_version=FORMAT_VERSION,
        policy=PolicyIdentity(
            name=spec.policy,
            family="made-up",
            checkpoint="none",
            checkpoint_format="embedded",
            digest="0" * 64,
            untrained=True,
            num_layers=spec.num_layers,
            num_heads=max(spec.heads) + 1,
            num_denoise_steps=max(spec.denoise_steps) + 1,
            action_horizon=5,
            cameras=cameras,
            config={"width": 8, "scale": 0.5},
        ),
        protocol=Protocol(
            suite=spec.suite, seed=spec.seed, wait_steps=10, replan_steps=5, max_steps=5 * spec.num_replans
        ),
        recording=Recording(
            layers=spec.layers,
            layer_labels=spec.layer_labels or spec.layers,
            denoise_steps=spec.denoise_steps,
            heads=spec.heads,
            queries=spec.queries,
            num_action_queries=spec.num_action_queries,
            mantissa_bits=spec.mantissa_bits,
            frames=spec.frames,
            contributions=spec.contributions,
        ),
        sites=(spec.layout,),
        provenance={"numpy": np.__version__},
    )


def episode_records(spec: StoreSpec, task: int, episode: int) -> tuple[EpisodeStart, list[ReplanRecord]]:
    """What the spec's episode consists of."""
    seed = [spec.seed, task, episode]
    tokens = spec.tokens or make_tokens(spec.replans, task, seed, changing=spec.prompts == "changing")
    generator = np.random.default_rng(seed)
    rows = random_rows(tokens, spec.cells, int(generator.integers(2**31)))
    if spec.plant_rows is not None:
        rows = spec.plant_rows(task, episode, tokens, rows).astype(np.float32)
    actions = None if spec.plant_actions is None else spec.plant_actions(task, episode, tokens.num_replans)
    assert tokens.prompt_index is not None
    seen = [span for span in tokens.layout.spans if span.camera in (tokens.coverage or {})]
    records = []
    for replan in range(tokens.num_replans):
        frames, coverage = {}, {}
        for span in seen:
            assert span.camera is not None
            assert span.grid is not None
            assert tokens.coverage is not None
            size = (span.grid.image_height, span.grid.image_width, 3)
            frames[span.camera] = generator.integers(0, 256, size, dtype=np.uint8)
            coverage[span.camera] = tokens.coverage[span.camera][replan]
        records.append(
            ReplanRecord(
                env_step=10 + 5 * replan,
                noise_seed=int(generator.integers(2**63 - 1)),
                rows={
                    "joint": RecordedRows(
                        rows[replan],
                        rows[replan].sum(axis=-1, dtype=np.float64).astype(np.float32),
                        gram_of(contribution_vectors(spec, tokens, seed, replan)) if spec.contributions else None,
                    )
                },
                key_role={"joint": tokens.key_role[replan]},
                prompt=tokens.prompts[tokens.prompt_index[replan]],
                state=generator.normal(size=8),
                actions=generator.normal(size=(5, 7)) if actions is None else actions[replan],
                frames=frames if spec.frames else {},
                coverage=coverage if spec.coverage else {},
            )
        )
    start = EpisodeStart(
        task_id=task,
        task_name=f"task_{task}",
        instruction=INSTRUCTIONS[task % len(INSTRUCTIONS)],
        episode_index=episode,
        initial_state_index=episode,
        initial_state_digest=f"{task:032x}{episode:032x}",
        objects=tokens.objects,
        provenance={"host": "made-up"},
    )
    return start, records


def contribution_vectors(spec: StoreSpec, tokens: EpisodeTokens, seed: list[int], replan: int) -> np.ndarray:
    """Made-up contributions (layer, denoise, query, segment, width) of a replan's segments."""
    segments = segments_of(tokens.layout, tokens.key_role[replan])
    shape = (*spec.cells[:2], spec.num_action_queries, len(segments), 4)
    return np.random.default_rng([*seed, replan, 1]).normal(size=shape)


def gram_of(vectors: np.ndarray) -> np.ndarray:
    """Gram matrix (layer, denoise, part, part) of segments and their sum, mean over queries."""
    parts = np.concatenate([vectors, vectors.sum(axis=3, keepdims=True)], axis=3)
    return np.einsum("ldqaw,ldqbw->ldab", parts, parts).astype(np.float32) / vectors.shape[2]


def small_layout(text_keys: int = 14) -> SiteLayout:
    """Two cameras that see something and a masked one, a prompt, actions: 3 x 4 + 2 x 2 + 2 x 2 + 14 + 5 = 39 keys."""
    spans: list[Span] = []
    grids = {"base_0_rgb": (3, 4), "left_wrist_0_rgb": (2, 2), "right_wrist_0_rgb": (2, 2)}
    for name, (rows, columns) in grids.items():
        start = spans[-1].stop if spans else 0
        grid = PatchGrid(rows, columns, rows * 4, columns * 4)
        spans.append(Span(name, "image", start, start + rows * columns, camera=name, grid=grid))
    spans.append(Span("prompt", "text", spans[-1].stop, spans[-1].stop + text_keys))
    spans.append(Span("actions", "action", spans[-1].stop, spans[-1].stop + 5))
    return SiteLayout("joint", tuple(spans))


def make_prompt(layout: SiteLayout, instruction: str, digits: str) -> tuple[Prompt, np.ndarray]:
    """A prompt "instruction; digits", one piece a word, after bos, and the roles (key,) of the prompt's span."""
    span = layout.span("prompt")
    roles = np.full(span.num_keys, Role.PADDING, dtype=np.uint8)
    roles[0] = Role.BOS
    pieces: list[Piece] = []
    position, key = 0, span.start + 1
    for word, role in [
        *((word, Role.INSTRUCTION) for word in instruction.split()),
        (";", Role.TEMPLATE),
        *((digit, Role.STATE) for digit in digits.split()),
    ]:
        text = word if not pieces or word == ";" else f" {word}"
        pieces.append(Piece(key, text, position, position + len(text)))
        roles[key - span.start] = role
        position, key = position + len(text), key + 1
    prompt = Prompt("".join(piece.text for piece in pieces), tuple(pieces), (0, len(instruction)))
    return prompt, roles


def make_tokens(replans: int, task: int, seed: Any, changing: bool = True) -> EpisodeTokens:
    """Tokens of an episode of `small_layout`; the state digits of a changing prompt differ in value and number."""
    layout = small_layout()
    generator = np.random.default_rng(seed)
    roles = np.zeros((replans, layout.num_keys), dtype=np.uint8)
    of_kind = {"image": Role.IMAGE, "text": Role.PADDING, "action": Role.ACTION}
    prompts: dict[Prompt, int] = {}
    index = []
    for replan in range(replans):
        for span in layout.spans:
            masked = span.name == "right_wrist_0_rgb"
            roles[replan, span.start : span.stop] = Role.MASKED_IMAGE if masked else of_kind[span.kind]
        digits = " ".join(str(generator.integers(256)) for _ in range(generator.integers(1, 4) if changing else 2))
        digits = digits if changing else "12 250"
        prompt, text_roles = make_prompt(layout, INSTRUCTIONS[task % len(INSTRUCTIONS)], digits)
        span = layout.span("prompt")
        roles[replan, span.start : span.stop] = text_roles
        index.append(prompts.setdefault(prompt, len(prompts)))
    coverage = {}
    for camera in layout.cameras[:2]:
        share = generator.dirichlet(np.full(len(OBJECTS), 0.3), (replans, layout.camera_span(camera).num_keys))
        coverage[camera] = share.astype(np.float32)
    return EpisodeTokens(layout, roles, tuple(prompts), np.array(index), OBJECTS, coverage)


def valid_keys(key_role: np.ndarray) -> np.ndarray:
    """Which keys can hold information."""
    return ~np.isin(key_role, [int(role) for role in INVALID_ROLES])
