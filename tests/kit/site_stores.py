"""Small stores of other policies than pi and Cosmos: sites in some of the blocks, absent keys, generated tokens.

    path = write_site_store(tmp_path / "a.zarr", kind="alternating")

Kinds:
    alternating  `self` in the even blocks (picture, prompt, state, actions), `cross` in the odd ones (without the
                 actions), as in SmolVLA
    split        `text` in the even blocks (prompt only), `image` in the odd ones (pictures only), as in GR00T
    growing      `joint` in all blocks: a picture, a prompt without padding (absent keys), generated tokens
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from tests.kit.tokens import INSTRUCTIONS
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedRows, ReplanRecord
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.groupings.key_counts import uniform_rows
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.layout import INVALID_ROLES, PatchGrid, Piece, Prompt, Role, SiteLayout, Span
from vla_attention.schemas.segments import segment_members, segments_of
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    STORE_VERSION,
    PolicyCameraView,
    PolicyIdentity,
    Protocol,
    Recording,
    RootAttributes,
)

_NUM_LAYERS, _NUM_HEADS, _PROMPT_KEYS = 4, 3, 12
#: Generated tokens of a replan of the kind `growing` that become keys, at most; the last token is never one.
GROWING_KEYS = 6


@dataclass(frozen=True)
class SiteStoreSpec:
    """What a store of `write_site_store` holds.

    `spread`: standard deviation of the logits; 0 gives rows that are uniform over the keys of each query. `outcome`:
    "known" (odd episodes are solved), "unknown" or "some" (every third is not known). `actions`, `state`, `frames`,
    `contributions`: whether they are stored. `dataset_actions`: the policy's actions plus this much noise; None for
    none. `bias`: added to the logits of image keys of a task and episode.
    """

    kind: Literal["alternating", "split", "growing"] = "alternating"
    tasks: tuple[int, ...] = (0, 1)
    episodes: int = 3
    replans: int = 4
    seed: int = 0
    queries: Literal["mean", "all"] = "mean"
    spread: float = 1.0
    bias: Callable[[int, int], float] | None = None
    outcome: Literal["known", "unknown", "some"] = "known"
    protocol: Literal["recorded", "dataset"] = "recorded"
    actions: bool = True
    state: bool = True
    frames: bool = True
    contributions: bool = True
    dataset_actions: float | None = None
    policy: str = "made-up"
    interventions: Interventions = field(default_factory=Interventions)
    rerun_of: RerunSource | None = None

    @property
    def sites(self) -> tuple[SiteLayout, ...]:
        """The sites of the kind."""
        picture = [("base", "image", 12, PatchGrid(3, 4, 12, 16)), ("wrist", "image", 4, PatchGrid(2, 2, 8, 8))]
        prompt: list[_Part] = [("prompt", "text", _PROMPT_KEYS, None)]
        state: list[_Part] = [("state", "state", 1, None)]
        actions: list[_Part] = [("actions", "action", 5, None)]
        even, odd = (0, 2), (1, 3)
        if self.kind == "alternating":
            prefix = [*picture, *prompt, *state]
            return (
                SiteLayout("self", _spans([*prefix, *actions]), layers=even, num_action_queries=5),
                SiteLayout("cross", _spans(prefix), layers=odd, heads=2, num_action_queries=5),
            )
        if self.kind == "split":
            return (
                SiteLayout("text", _spans(prompt), layers=even, num_action_queries=6),
                SiteLayout("image", _spans(picture), layers=odd, num_action_queries=6),
            )
        *known, generated = _spans([*picture, *prompt, ("generated", "action", GROWING_KEYS, None)])
        return (
            SiteLayout(
                "joint", (*known, structs.replace(generated, growing=True)), num_action_queries=GROWING_KEYS + 1
            ),
        )


_Part = tuple[str, Any, int, PatchGrid | None]


def _spans(parts: Sequence[_Part]) -> tuple[Span, ...]:
    spans, start = [], 0
    for name, kind, length, grid in parts:
        camera = name if grid is not None else None
        spans.append(Span(name, kind, start, start + length, camera=camera, grid=grid))
        start += length
    return tuple(spans)


def site_root(spec: SiteStoreSpec) -> RootAttributes:
    """The attributes of the store's root group."""
    cameras = dict.fromkeys(camera for site in spec.sites for camera in site.cameras)
    return RootAttributes(
        format=FORMAT_NAME,
        store_version=STORE_VERSION,
        policy=PolicyIdentity(
            name=spec.policy,
            family=f"made-up-{spec.kind}",
            checkpoint="none",
            checkpoint_format="caller",
            digest="0" * 64,
            untrained=False,
            num_layers=_NUM_LAYERS,
            num_heads=_NUM_HEADS,
            num_denoise_steps=2,
            action_horizon=5,
            cameras=tuple(PolicyCameraView(name, name, True, False) for name in cameras),
            config={"dtype": "float32"},
        ),
        protocol=Protocol(spec.protocol, "made_up", spec.seed, 0, 0, 0, 0),
        recording=Recording(
            layers=tuple(range(_NUM_LAYERS)),
            layer_labels=tuple(range(_NUM_LAYERS)),
            denoise_steps=(0, 1),
            heads=tuple(range(_NUM_HEADS)),
            queries=spec.queries,
            num_action_queries=5,
            mantissa_bits=10,
            frames=spec.frames,
            contributions=spec.contributions,
        ),
        sites=spec.sites,
        provenance={"numpy": np.__version__},
        interventions=spec.interventions,
        rerun_of=spec.rerun_of,
    )


def write_site_store(path: Path, spec: SiteStoreSpec | None = None, **changes: Any) -> Path:
    """Write a store with every episode of a spec, or of the default one with some fields changed; returns its path."""
    spec = replace(spec or SiteStoreSpec(), **changes)
    store = open_run(path, site_root(spec), "new", durable=False)
    for number, (task, episode) in enumerate((task, e) for task in spec.tasks for e in range(spec.episodes)):
        start, records = site_records(spec, task, episode)
        with store.episode(start, np.array([1.0, 0.5])) as writer:
            for record in records:
                writer.append(record)
            known = spec.outcome == "known" or (spec.outcome == "some" and number % 3 < 2)
            writer.commit(success=episode % 2 == 1 if known else None, num_steps=0)
    return path


def site_records(spec: SiteStoreSpec, task: int, episode: int) -> tuple[EpisodeStart, list[ReplanRecord]]:
    """What the writer is given for one episode: its start and one record per replan."""
    generator = np.random.default_rng([spec.seed, task, episode])
    instruction = INSTRUCTIONS[task % len(INSTRUCTIONS)]
    records = []
    for replan in range(spec.replans):
        rows, roles = {}, {}
        for site in spec.sites:
            roles[site.name] = _roles(spec, site, instruction, replan)
            rows[site.name] = _rows(spec, site, roles[site.name], generator, (task, episode))
        actions = generator.normal(size=(5, 3))
        noise = generator.normal(size=(5, 3))
        # The data set's episode ends with its last replan.
        left = 5 if replan + 1 < spec.replans else 2
        records.append(
            ReplanRecord(
                env_step=5 * replan,
                noise_seed=None,
                rows=rows,
                key_role=roles,
                prompt=_prompt(spec, instruction, replan),
                state=generator.normal(size=4) if spec.state else None,
                actions=actions if spec.actions else None,
                frames={
                    span.name: generator.integers(0, 256, (span.grid.image_height, span.grid.image_width, 3), np.uint8)
                    for site in spec.sites
                    for span in site.spans
                    if span.grid is not None
                }
                if spec.frames
                else {},
                dataset_actions=None
                if spec.dataset_actions is None
                else (actions + spec.dataset_actions * noise)[:left],
            )
        )
    start = EpisodeStart(task, f"task_{task}", instruction, episode, episode, "", (), {"host": "made-up"})
    return start, records


def _words(instruction: str, replan: int) -> list[str]:
    """The pieces of the prompt: the instruction, and at odd replans one word more."""
    return [*instruction.split(), *(["now"] if replan % 2 else [])]


def _prompt(spec: SiteStoreSpec, instruction: str, replan: int) -> Prompt:
    first = next(span for site in spec.sites for span in site.spans if span.kind == "text")
    pieces, position = [], 0
    for i, word in enumerate(_words(instruction, replan)):
        text = word if i == 0 else f" {word}"
        pieces.append(Piece(first.start + 1 + i, text, position, position + len(text)))
        position += len(text)
    return Prompt("".join(piece.text for piece in pieces), tuple(pieces), (0, len(instruction)))


def _roles(spec: SiteStoreSpec, site: SiteLayout, instruction: str, replan: int) -> NDArray[np.uint8]:
    of_kind = {"image": Role.IMAGE, "state": Role.PROPRIO, "action": Role.ACTION}
    left = Role.ABSENT if spec.kind == "growing" else Role.PADDING
    roles = np.zeros(site.num_keys, dtype=np.uint8)
    for span in site.spans:
        if span.kind == "text":
            words = len(_words(instruction, replan))
            roles[span.start : span.stop] = left
            roles[span.start] = Role.BOS
            roles[span.start + 1 : span.start + 1 + words] = Role.INSTRUCTION
            roles[span.start + 1 + len(instruction.split()) : span.start + 1 + words] = Role.TEMPLATE
        else:
            roles[span.start : span.stop] = Role.STATE if span.kind == "state" else of_kind[span.kind]
        if span.growing:
            roles[span.stop - replan % 3 : span.stop] = Role.ABSENT  # every third replan generates all tokens
    return roles


def key_exists(site: SiteLayout, key_role: NDArray[np.uint8], num_queries: int) -> NDArray[np.bool_]:
    """Which keys exist for which query, (query, key); absent generated tokens leave fewer queries."""
    absent = key_role == Role.ABSENT
    growing = site.growing_span
    if growing is None:
        return np.broadcast_to(~absent, (num_queries, len(absent)))
    queries = num_queries - int(absent[growing.start : growing.stop].sum())
    exists = np.repeat(~absent[None], queries, axis=0)
    for query in range(queries):
        exists[query, growing.start + query + growing.growing_offset : growing.stop] = False
    return exists


def _rows(
    spec: SiteStoreSpec,
    site: SiteLayout,
    key_role: NDArray[np.uint8],
    generator: np.random.Generator,
    episode: tuple[int, int],
) -> RecordedRows:
    recording = site_root(spec).recording.of_site(site)
    valid = ~np.isin(key_role, INVALID_ROLES)
    exists = key_exists(site, key_role, recording.num_action_queries) & valid
    cells = (len(recording.layers), len(recording.denoise_steps), len(recording.heads))
    logits = generator.normal(0, spec.spread, (*cells, *exists.shape))
    if spec.bias is not None:
        logits[..., key_role == Role.IMAGE] += spec.bias(*episode)
    weights = np.exp(logits) * exists
    rows = weights / weights.sum(axis=-1, keepdims=True)
    uniform = uniform_rows(exists)[None, None, None]
    if spec.queries == "mean":
        rows, uniform = (of_all.mean(axis=3, keepdims=True) for of_all in (rows, uniform))
    rows = rows.astype(np.float32)
    gram = None
    if spec.contributions:
        segments = segments_of(site, key_role)
        mass = rows.mean(axis=(2, 3)) @ segment_members(site, key_role[None], segments)[0].astype(np.float64)
        vectors = mass[..., None] * generator.normal(size=(*mass.shape, 4))
        parts = np.concatenate([vectors, vectors.sum(axis=2, keepdims=True)], axis=2)
        gram = np.einsum("ldaw,ldbw->ldab", parts, parts).astype(np.float32)
    return RecordedRows.summed(rows, gram, uniform.astype(np.float32))
