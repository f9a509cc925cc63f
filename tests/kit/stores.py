"""Small stores with known content, written by the writer that capture uses.

    path = write_store(tmp_path / "a.zarr", tasks=(0, 2), episodes=3)
    expected_arrays(StoreSpec(tasks=(0, 2), episodes=3), task=2, episode=0)["joint/rows"]

A `StoreSpec` decides every number in its store, so that what a reader must find is computed from the spec alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from msgspec import structs
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from tests.kit.tokens import INSTRUCTIONS, random_rows, small_layout, small_tokens
from vla_attention.capture.store.codecs import CHUNK_KEYS
from vla_attention.capture.store.episode_writer import EpisodeWriter
from vla_attention.capture.store.replan_records import (
    EpisodeStart,
    RecordedRows,
    RecordedSteps,
    ReplanEffects,
    ReplanRecord,
)
from vla_attention.capture.store.store_writer import RunStore, WriteMode, open_run
from vla_attention.schemas.effects import EffectItem, EffectItems, EffectsRecorded
from vla_attention.schemas.episode_steps import HAND, EpisodeSteps, TaskGoal
from vla_attention.schemas.groupings.key_counts import uniform_of_roles
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange, RerunSource
from vla_attention.schemas.layout import Role, SiteLayout, picture_size
from vla_attention.schemas.precision import as_read
from vla_attention.schemas.segments import segment_members, segments_of
from vla_attention.schemas.stores.digest import with_digest
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.root import read_run
from vla_attention.schemas.stores.seal import seal_episode
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    STORE_VERSION,
    PolicyCameraView,
    PolicyIdentity,
    Protocol,
    Recording,
    RootAttributes,
)
from vla_attention.schemas.stores.verify import verify_store

#: Task, episode, the episode's tokens and random rows (replan, layer, denoise, head, query, key) to the rows to store.
PlantRows = Callable[[int, int, EpisodeTokens, NDArray[np.float32]], NDArray[np.floating]]
#: The episode's tokens and the lengths (layer, denoise, head, query) to what uniform attention gives, (replan, layer,
#: denoise, head, query, key); lengths but that of keys may be 1 where nothing changes.
PlantUniform = Callable[[EpisodeTokens, tuple[int, int, int, int]], NDArray[np.floating]]
#: Task, episode and the episode's tokens to covered areas by camera, (replan, patch, object).
PlantCoverage = Callable[[int, int, EpisodeTokens], Mapping[str, NDArray[np.float32]]]
#: Task, episode and number of replans to actions (replan, horizon, action_dim).
PlantActions = Callable[[int, int, int], NDArray[np.float64]]
#: Task, episode, replan and the episode's tokens to the effects of the replan; see `small_effects`.
PlantEffects = Callable[[int, int, int, EpisodeTokens], ReplanEffects]
#: The spec, task, episode and number of steps to what a simulator told of the steps; see `small_steps`.
PlantSteps = Callable[["StoreSpec", int, int, int], RecordedSteps]
#: Task and episode to the outcome.
PlantSuccess = Callable[[int, int], bool]


@dataclass(frozen=True)
class StoreSpec:
    """What a made-up store holds.

    Every episode has `replans` replans. `tokens`, when given, are the tokens of every episode (and decide the number
    of replans); otherwise each episode has those of `small_tokens`. `prompts`: "changing" (state digits, as in pi0.5)
    or "same". `seed` decides all random numbers. `layers` are blocks of `num_layers`; the other fields of the recording
    are as in `Recording`. `interventions` and `rerun_of` (see `rerun_source`) are what the store says that its run
    changed and repeated. The `plant_` functions replace rows, what uniform attention gives, coverage, actions and
    outcomes; without them rows are random, every query sees every key that is not masked, and episodes of odd numbers
    are solved.
    """

    suite: str = "made_up"
    tasks: tuple[int, ...] = (0, 1)
    #: Families of tasks, where they are known.
    task_families: Mapping[int, str] = field(default_factory=dict)
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
    interventions: Interventions = field(default_factory=Interventions)
    rerun_of: RerunSource | None = None
    tokens: EpisodeTokens | None = None
    plant_rows: PlantRows | None = None
    plant_uniform: PlantUniform | None = None
    plant_coverage: PlantCoverage | None = None
    plant_actions: PlantActions | None = None
    plant_success: PlantSuccess | None = None
    plant_effects: PlantEffects | None = None
    effect_items: tuple[EffectItems, ...] = ("text",)
    plant_steps: PlantSteps | None = None

    @property
    def layout(self) -> SiteLayout:
        """The spans of the store's only site, `joint`."""
        return small_layout() if self.tokens is None else self.tokens.layout

    @property
    def num_replans(self) -> int:
        """Replans of every episode."""
        return self.replans if self.tokens is None else self.tokens.num_replans

    @property
    def cells(self) -> tuple[int, int, int, int]:
        """Lengths of the axes (layer, denoise, head, query)."""
        queries = 1 if self.queries == "mean" else self.num_action_queries
        return (len(self.layers), len(self.denoise_steps), len(self.heads), queries)

    @property
    def names(self) -> list[tuple[int, int]]:
        """(task, episode) of every episode, in order."""
        return [(task, episode) for task in self.tasks for episode in range(self.episodes)]


def write_store(
    path: Path, *, mode: WriteMode = "new", durable: bool = False, spec: StoreSpec | None = None, **changes: Any
) -> Path:
    """Write a store with every episode of a spec, or of the default one with some fields changed; returns its path.

    `mode`: "resume" adds what is missing, "overwrite" replaces the store. `durable`: flush every file to disk, which
    takes long and is of use only in tests of crashes.
    """
    spec = replace(spec or StoreSpec(), **changes)
    store = open_run(path, root_attributes(spec), mode, durable=durable)
    for task, episode in spec.names:
        if (task, episode) not in store.committed():
            write_episode(store, spec, task, episode)
    return path


def write_episode(store: RunStore, spec: StoreSpec, task: int, episode: int) -> Path:
    """Write and commit one episode."""
    start, records = episode_records(spec, task, episode)
    with store.episode(start, denoise_times(spec)) as writer:
        for record in records:
            writer.append(record)
        return commit(writer, spec, task, episode)


def commit(writer: EpisodeWriter, spec: StoreSpec, task: int, episode: int) -> Path:
    """Commit with the outcome of the episode: unless planted, episodes of odd numbers are solved."""
    steps = None if spec.plant_steps is None else spec.plant_steps(spec, task, episode, num_steps(spec, episode))
    return writer.commit(solved(spec, task, episode), num_steps(spec, episode), steps)


def solved(spec: StoreSpec, task: int, episode: int) -> bool:
    """Whether an episode is solved."""
    return spec.plant_success(task, episode) if spec.plant_success else episode % 2 == 1


def num_steps(spec: StoreSpec, episode: int) -> int:
    """Environment steps of an episode."""
    return 5 * spec.num_replans - episode % 2


def write_array(folder: Path, values: NDArray[Any], **settings: Any) -> None:
    """Write an array as zarr-python does in the format's layout; settings: chunks, shards, or what a test changes."""
    compressors = (BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle", typesize=values.itemsize), Crc32cCodec())
    array = zarr.create_array(
        folder,
        shape=values.shape,
        dtype=values.dtype,
        **{
            "compressors": compressors,
            "fill_value": float("nan") if values.dtype.kind == "f" else 0,
            "chunk_key_encoding": CHUNK_KEYS,
            "dimension_names": [f"axis{i}" for i in range(values.ndim)],
            "config": {"write_empty_chunks": True},
            **settings,
        },
    )
    array[...] = values


def reseal(folder: Path) -> None:
    """Seal a committed episode anew, after a test has changed its files: it then passes for what was captured."""
    seal_episode(folder, folder.name, read_run(folder.parents[1])[1])


def reseal_root(store: Path) -> None:
    """Make the digest in a store's root anew, after a test has changed the attributes there."""
    document = json.loads((store / "zarr.json").read_bytes())
    document["attributes"] = with_digest(document["attributes"])
    (store / "zarr.json").write_text(json.dumps(document), encoding="utf-8")


def denoise_times(spec: StoreSpec) -> NDArray[np.float64]:
    """Flow time of each recorded denoise step, shape (denoise,)."""
    return 1.0 - np.array(spec.denoise_steps) / 10


def root_attributes(spec: StoreSpec) -> RootAttributes:
    """The attributes of the store's root group."""
    return RootAttributes(
        format=FORMAT_NAME,
        store_version=STORE_VERSION,
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
            cameras=tuple(PolicyCameraView(name, f"{name}_image", True, False) for name in spec.layout.cameras),
            config={"width": 8, "scale": 0.5},
        ),
        protocol=Protocol(
            suite=spec.suite,
            seed=spec.seed,
            wait_steps=10,
            replan_steps=5,
            max_steps=5 * spec.num_replans,
            name="openpi",
            image_size=256,
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
            effects=None
            if spec.plant_effects is None
            else EffectsRecorded(spec.effect_items, ("all", "action"), every=1, denoise_steps=1, seed=1),
        ),
        sites=(spec.layout,),
        provenance={"numpy": np.__version__},
        interventions=spec.interventions,
        rerun_of=spec.rerun_of,
    )


def rerun_source(path: Path) -> RerunSource:
    """What a rerun of the store at `path` says of it."""
    return RerunSource(read_run(path)[1], path.name)


def episode_records(spec: StoreSpec, task: int, episode: int) -> tuple[EpisodeStart, list[ReplanRecord]]:
    """What the writer is given for one episode: its start and one record per replan."""
    seed = [spec.seed, task, episode]
    tokens = spec.tokens or small_tokens(spec.replans, task, seed, changing=spec.prompts == "changing")
    if spec.plant_coverage is not None:
        tokens = replace(tokens, coverage=spec.plant_coverage(task, episode, tokens))
    generator = np.random.default_rng(seed)
    rows = random_rows(tokens, spec.cells, int(generator.integers(2**31)))
    if spec.plant_rows is not None:
        rows = spec.plant_rows(task, episode, tokens, rows).astype(np.float32)
    uniform = None
    if spec.plant_uniform is not None:
        uniform = spec.plant_uniform(tokens, spec.cells).astype(np.float32)
        uniform = np.broadcast_to(uniform, (tokens.num_replans, *uniform.shape[1:]))
    actions = None if spec.plant_actions is None else spec.plant_actions(task, episode, tokens.num_replans)
    assert tokens.prompt_index is not None
    covered = tokens.coverage or {}
    records = []
    for replan in range(tokens.num_replans):
        frames, coverage = {}, {}
        for camera in tokens.layout.pictured:
            if camera in covered:
                size = (*picture_size([tokens.layout], camera), 3)
                frames[camera] = generator.integers(0, 256, size, dtype=np.uint8)
                coverage[camera] = covered[camera][replan]
        noise_seed, state = int(generator.integers(2**63 - 1)), generator.normal(size=8)
        # Drawn also where others are planted: a rerun with other actions was made from the same states.
        drawn = generator.normal(size=(5, 7))
        records.append(
            ReplanRecord(
                env_step=10 + 5 * replan,
                noise_seed=noise_seed,
                rows={
                    "joint": RecordedRows.summed(
                        rows[replan],
                        gram_of(contribution_vectors(spec, tokens, seed, replan)) if spec.contributions else None,
                        None if uniform is None else uniform[replan],
                    )
                },
                key_role={"joint": tokens.key_role[replan]},
                prompt=tokens.prompts[tokens.prompt_index[replan]],
                state=state,
                actions=drawn if actions is None else actions[replan],
                frames=frames if spec.frames else {},
                coverage=coverage if spec.coverage else {},
                effects=None if spec.plant_effects is None else spec.plant_effects(task, episode, replan, tokens),
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
        task_family=spec.task_families.get(task, ""),
    )
    return start, records


#: The conditions of `small_effects`.
SMALL_CONDITIONS = (
    Interventions("unchanged"),
    Interventions("noise", noise=NoiseChange(1)),
    Interventions("without_instruction_queries_all", keys=(KeyKnockout("role:instruction", queries="all"),)),
    Interventions("without_instruction", keys=(KeyKnockout("role:instruction"),)),
    Interventions("random_instruction", keys=(KeyKnockout("role:instruction", random_seed=1),)),
)
_ITEM = EffectItem("without", "part", "instruction", reader="all")
SMALL_ITEMS = (EffectItem("nothing"), EffectItem("noise"), _ITEM, structs.replace(_ITEM, reader="action"),
               structs.replace(_ITEM, change="random", reader="action"))  # fmt: skip


def small_effects(task: int, episode: int, replan: int, tokens: EpisodeTokens) -> ReplanEffects:
    """`PlantEffects` of random changes under `SMALL_CONDITIONS`; replans of odd numbers lack the last one."""
    measured = tuple(range(len(SMALL_CONDITIONS) - replan % 2))
    change = np.random.default_rng([task, episode, replan]).normal(size=(len(measured), 5, 7))
    change[0] = 0.0
    cut = np.zeros((len(measured), tokens.layout.num_keys), np.float32)
    cut[2:] = tokens.key_role[replan] == Role.INSTRUCTION
    return ReplanEffects(SMALL_CONDITIONS, SMALL_ITEMS, (2.0,) * 7, measured, change.astype(np.float32), {"joint": cut})


def small_steps(spec: StoreSpec, task: int, episode: int, steps: int) -> RecordedSteps:
    """`PlantSteps` of random poses: the hand touches the first object, and the goals of all tasks are in the scene.

    An episode reaches its own goal at its end if it is solved, and no other.
    """
    generator = np.random.default_rng([spec.seed, task, episode, steps])
    start, _ = episode_records(spec, task, episode)
    objects = [thing.name for thing in start.objects if thing.kind == "object"]
    bodies = (HAND, *objects)
    poses = generator.normal(size=(steps + 1, len(bodies), 7))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    goals = tuple(
        TaskGoal(
            other,
            f"task_{other}",
            INSTRUCTIONS[other % len(INSTRUCTIONS)],
            (f"on thing_{other} table",),
            steps if other == task and solved(spec, task, episode) else None,
        )
        for other in spec.tasks
    )
    return RecordedSteps(
        EpisodeSteps(bodies, (None, steps // 2, *(None for _ in objects[1:])), goals),
        poses.astype(np.float32),
        generator.uniform(0, 0.04, (steps + 1, 2)).astype(np.float32),
        generator.normal(size=(steps, 7)).astype(np.float32),
    )


def every_key_seen(tokens: EpisodeTokens, _cells: tuple[int, int, int, int]) -> NDArray[np.float64]:
    """`PlantUniform` of queries that see all keys, masked ones too, as Cosmos's null keys are seen."""
    return np.full((1,) * 5 + (tokens.layout.num_keys,), 1.0 / tokens.layout.num_keys)


def expected_arrays(spec: StoreSpec, task: int, episode: int) -> dict[str, NDArray[Any]]:
    """Name to values of the arrays that a reader must find in one episode, to the bit.

    Among them are numbers that are attributes of the episode, such as `env_step`. Left out is `joint/contribution`.
    Rows are rounded to the spec's mantissa bits; `joint/atoms` has the segments of `segments_of`, then the sum.
    """
    _, records = episode_records(spec, task, episode)
    rows = np.stack([record.rows["joint"].rows for record in records])
    roles = np.stack([record.key_role["joint"] for record in records])
    sums = [record.rows["joint"].row_sum for record in records]
    members = segment_members(spec.layout, roles, segments_of(spec.layout, roles))
    prompts = list(dict.fromkeys(record.prompt for record in records))
    arrays: dict[str, NDArray[Any]] = {
        "joint/rows": as_read(rows, spec.mantissa_bits),
        "joint/atoms": np.stack(
            [
                np.append(row.astype(np.float64) @ of.astype(np.float64), row_sum[..., None], -1).astype(np.float32)
                for row, of, row_sum in zip(rows, members, sums, strict=True)
            ]
        ),
        **_uniform_once([record.rows["joint"].uniform for record in records], roles),
        "joint/key_role": roles,
        "env_step": np.array([record.env_step for record in records], dtype=np.int32),
        "noise_seed": np.array([record.noise_seed for record in records], dtype=np.int64),
        "prompt_index": np.array([prompts.index(record.prompt) for record in records], dtype=np.int32),
        "denoise_time": denoise_times(spec).astype(np.float32),
        "state": np.stack([record.state for record in records if record.state is not None]),
        "actions": np.stack([record.actions for record in records if record.actions is not None]),
    }
    effects = [record.effects for record in records if record.effects is not None]
    if effects:
        arrays["effects/change"] = np.concatenate([of.change for of in effects])
        arrays["joint/cut"] = np.concatenate([of.cut["joint"] for of in effects])
    if spec.plant_steps is not None:
        steps = spec.plant_steps(spec, task, episode, num_steps(spec, episode))
        arrays |= {name: values for name, (values, _) in steps.arrays.items()}
    for camera in records[0].frames:
        arrays[f"frames/{camera}"] = np.stack([record.frames[camera] for record in records])
    for camera in records[0].coverage:
        arrays[f"objects/{camera}"] = np.stack([record.coverage[camera] for record in records])
    return arrays


def _uniform_once(
    uniform: Sequence[NDArray[np.float32] | None], roles: NDArray[np.uint8]
) -> dict[str, NDArray[np.float32]]:
    """What uniform attention gives at each replan, once along every axis (but keys) along which it is the same.

    Nothing where the roles say it.
    """
    given = [
        uniform_of_roles(role)[None, None, None, None] if one is None else one
        for one, role in zip(uniform, roles, strict=True)
    ]
    cells = np.broadcast_shapes(*(one.shape for one in given))
    whole = np.stack([np.broadcast_to(one, cells) for one in given]).astype(np.float32)
    if (whole == uniform_of_roles(roles)[:, None, None, None, None].astype(np.float32)).all():
        return {}
    for axis in range(whole.ndim - 1):
        first = whole.take([0], axis=axis)
        whole = first if (whole == first).all() else whole
    return {"joint/uniform": whole}


def contribution_vectors(spec: StoreSpec, tokens: EpisodeTokens, seed: list[int], replan: int) -> NDArray[np.float64]:
    """Made-up contributions (layer, denoise, query, segment, width) of a replan's segments."""
    segments = segments_of(tokens.layout, tokens.key_role[replan])
    shape = (*spec.cells[:2], spec.num_action_queries, len(segments), 4)
    return np.random.default_rng([*seed, replan, 1]).normal(size=shape)


def gram_of(vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Gram matrix (layer, denoise, part, part) of segments and their sum, mean over queries."""
    parts = np.concatenate([vectors, vectors.sum(axis=3, keepdims=True)], axis=3)
    gram: NDArray[np.float32] = np.einsum("ldqaw,ldqbw->ldab", parts, parts).astype(np.float32) / vectors.shape[2]
    return gram


def assert_whole(path: Path) -> None:
    """Raise `AssertionError` with every fault of the store at `path`."""
    faults = verify_store(open_store(path))
    assert not faults, "; ".join(f"{fault.where}: {fault.problem}" for fault in faults)
