"""How often `objects` claims something about naming where attention cannot know the sentence, and where it does.

    python benchmarks/null_objects.py                        # 100 stores of each kind, some minutes
    python benchmarks/null_objects.py --stores 400           # the limit: 7 %, 5 % and two standard errors
    python benchmarks/null_objects.py --store runs/cubes.zarr
    python benchmarks/null_objects.py --maps                 # of `effects`: that what is named moves the action more

Stores have the scenes, sentences and first two policy calls of a real run of `cubes` (the shipped example, or
`--store`), and made-up attention. In a null store it follows something in the picture, whatever the sentence says
(`FOLLOWS`); every key, every object and every episode scatter. In a planted store the named object gets twice as much.
Each is asked twice: as it is, where tasks share initial states, and with a state of its own for every episode.

    thrice    the first episode of each task three times: over its place must be 1
    spatial   ten tasks as in `libero_spatial`: one kind always named. Attention goes to one kind always
    object    ten tasks as in `libero_object`: another thing named in each. Attention goes to one kind always
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import vla_attention as va
from tests.kit.stores import StoreSpec, root_attributes
from tests.kit.tokens import site_layout, small_prompt
from vla_attention.analyze.commands.effects.maps import ASKS_NAMED
from vla_attention.capture.store.replan_records import (
    EpisodeStart,
    RecordedRows,
    ReplanEffects,
    ReplanMap,
    ReplanRecord,
)
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.effects import EffectItem, EffectMap, EffectsRecorded, MapBlocks
from vla_attention.schemas.episode_steps import HAND, POSES
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import Interventions, NoiseChange
from vla_attention.schemas.layout import Prompt, Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import RootAttributes

Array = NDArray[np.float64]
REPLANS = 2
#: Times even attention that is followed, and what a planted store gives the named object.
STRENGTH, PLANTED = 4.0, 2.0
#: Standard deviations of the logarithm of attention: of a key, of an object, in an episode; of a key at a call.
KEY, OBJECT, CALL = 0.3, 0.3, 0.2


@dataclass(frozen=True)
class Scene:
    """An episode without attention.

    coverage: of each camera (replan, patch, object). look: of each camera, brightness, saturation and contrast of
    patches, (replan, patch, 3). near: the object that is nearest to the hand.
    """

    start: EpisodeStart
    prompt: Prompt
    key_role: NDArray[np.uint8]
    coverage: Mapping[str, NDArray[np.float32]]
    look: Mapping[str, Array]
    near: str

    @property
    def things(self) -> list[int]:
        """The objects that are no robot and no background."""
        return [i for i, thing in enumerate(self.start.objects) if thing.kind == "object"]

    def of(self, name: str, camera: str) -> Array:
        """What the object covers, (replan, patch)."""
        names = [thing.name for thing in self.start.objects]
        return self.coverage[camera][:, :, names.index(name)].astype(np.float64)


def looks_of(frames: NDArray[np.uint8], side: int) -> Array:
    """Brightness, saturation and contrast of patches, (replan, patch, 3), each from 0 to 1 in its picture."""
    size = frames.shape[1] // side
    cut = frames.astype(np.float64).reshape(len(frames), side, size, side, size, 3).swapaxes(2, 3) / 255
    cut = cut.reshape(len(frames), side * side, size * size, 3)
    each = np.stack([cut.mean((2, 3)), np.ptp(cut, axis=3).mean(2), cut.mean(3).std(2)], axis=-1)
    return (each - each.min(1, keepdims=True)) / np.ptp(each, axis=1, keepdims=True)


def scenes_of(path: Path) -> tuple[RootAttributes, list[Scene]]:
    """The scenes of a run of `cubes`, and the attributes of a store with one layer and head."""
    store, scenes = open_store(path), []
    for episode in store.episodes:
        about, tokens = episode.attributes, episode.tokens(store.attributes, "joint")
        assert about.steps is not None
        poses = episode.read(POSES)[0, :, :3]
        apart = {name: np.linalg.norm(poses[i] - poses[0]) for i, name in enumerate(about.steps.bodies) if name != HAND}
        coverage = {camera: area[:REPLANS] for camera, area in (tokens.coverage or {}).items()}
        look = {
            camera: looks_of(episode.read(f"frames/{camera}")[:REPLANS], int(np.sqrt(area.shape[1])))
            for camera, area in coverage.items()
        }
        start = EpisodeStart(about.task_id, about.task_name, about.instruction, about.episode_index,
                             about.initial_state_index, about.initial_state_digest, about.objects, {},
                             about.task_family)  # fmt: skip
        near = min(apart, key=lambda name: float(apart[name]))
        scenes.append(Scene(start, tokens.prompts[0], tokens.key_role[:REPLANS], coverage, look, near))
    root = store.attributes
    recording = structs.replace(root.recording, layers=(0,), layer_labels=(0,), denoise_steps=(9,), heads=(0,),
                                frames=False, contributions=False, effects=None)  # fmt: skip
    return structs.replace(root, recording=recording), scenes


Follow = Callable[[Scene, str, int], Array]


def _cube(choose: Callable[[Scene, int], str]) -> Follow:
    return lambda scene, camera, seed: scene.of(choose(scene, seed), camera)


def _names(scene: Scene) -> list[str]:
    return [scene.start.objects[i].name for i in scene.things]


def _sum(scene: Scene, name: str) -> float:
    return sum(float(scene.of(name, camera)[0].mean()) for camera in scene.coverage)


def _left(scene: Scene, name: str) -> float:
    area = scene.of(name, next(iter(scene.coverage)))[0]
    side = int(np.sqrt(len(area)))
    return float((area * (np.arange(len(area)) % side)).sum() / max(area.sum(), 1e-9))


def _drawn(scene: Scene, seed: int) -> str:
    names = _names(scene)
    generator = np.random.default_rng([seed, scene.start.task_id, scene.start.episode_index, 7])
    return names[int(generator.integers(len(names)))]


def _middle(scene: Scene, camera: str, seed: int) -> Array:
    side = int(np.sqrt(scene.coverage[camera].shape[1]))
    row, column = (np.indices((side, side)).reshape(2, -1) + 0.5) / side - 0.5
    blob: Array = np.exp(-(row**2 + column**2) / 0.06)
    return np.broadcast_to(blob, (REPLANS, side * side))


#: What attention follows, (replan, patch) from 0 to 1 of a scene, a camera and the number of the store.
FOLLOWS: Mapping[str, Follow] = {
    "uniform": lambda scene, camera, seed: np.zeros(scene.coverage[camera].shape[:2]),
    "every cube alike": lambda scene, camera, seed: np.sum([scene.of(name, camera) for name in _names(scene)], axis=0),
    "nearest the hand": _cube(lambda scene, seed: scene.near),
    "largest object": _cube(lambda scene, seed: max(_names(scene), key=lambda name: _sum(scene, name))),
    "leftmost object": _cube(lambda scene, seed: min(_names(scene), key=lambda name: _left(scene, name))),
    "one kind always": _cube(lambda scene, seed: _names(scene)[seed % len(_names(scene))]),
    "a drawn object": _cube(_drawn),
    "saturated patches": lambda scene, camera, seed: scene.look[camera][..., 1],
    "bright patches": lambda scene, camera, seed: scene.look[camera][..., 0],
    "edges": lambda scene, camera, seed: scene.look[camera][..., 2],
    "fixed middle": _middle,
    "the robot": lambda scene, camera, seed: scene.of("robot", camera),
}


def rows_of(scene: Scene, root: RootAttributes, follow: Follow, seed: int, planted: float) -> Array:
    """Rows (replan, key) of an episode."""
    site, places = root.sites[0], [seed, scene.start.task_id, scene.start.episode_index]
    generator = np.random.default_rng(places)
    log = generator.normal(0, KEY, site.num_keys) + generator.normal(0, CALL, (REPLANS, site.num_keys))
    of_object = generator.normal(0, OBJECT, len(scene.start.objects))
    named = np.array([thing.of_interest and thing.kind == "object" for thing in scene.start.objects])
    for camera, area in scene.coverage.items():
        keys = site.patch_keys(camera)
        log[:, keys] += np.log1p((STRENGTH - 1) * follow(scene, camera, seed)) + area @ of_object
        log[:, keys] += np.log1p((planted - 1) * np.minimum(area[..., named].sum(-1), 1.0))
    rows: Array = np.exp(log) * ~np.isin(scene.key_role, [Role.PADDING, Role.MASKED_IMAGE])
    return rows / rows.sum(axis=-1, keepdims=True)


def write(path: Path, root: RootAttributes, scenes: Sequence[Scene], rows: Sequence[Array], maps: bool = False) -> Path:
    """A store of the scenes with these rows; maps: also with a map of every patch, which moves the action as much as it
    is attended to."""
    if maps:
        effects = EffectsRecorded(("map",), ("all",), 1, root.policy.num_denoise_steps, 1,
                                  blocks=MapBlocks("hidden", 8, 8))  # fmt: skip
        root = structs.replace(root, recording=structs.replace(root.recording, effects=effects))
    store = open_run(path, root, "new", durable=False)
    for scene, own in zip(scenes, rows, strict=True):
        with store.episode(scene.start, np.array([0.1])) as writer:
            for replan in range(REPLANS):
                recorded = RecordedRows.summed(own[replan].astype(np.float32)[None, None, None, None])
                writer.append(ReplanRecord(
                    10 + 5 * replan, 1, {"joint": recorded}, {"joint": scene.key_role[replan]}, scene.prompt,
                    np.zeros(8), np.random.default_rng([replan, scene.start.task_id]).normal(size=(5, 7)) * maps,
                    coverage={camera: area[replan] for camera, area in scene.coverage.items()},
                    effects=_map_of(root, scene, own[replan]) if maps else None,
                ))  # fmt: skip
            writer.commit(True, 5 * REPLANS, None)
    return path


def _map_of(root: RootAttributes, scene: Scene, row: Array) -> ReplanEffects:
    site = root.sites[0]
    keys = tuple(int(key) for camera in scene.coverage for key in site.patch_keys(camera))
    form = EffectMap(site.name, keys, 0, 5, (), (), (), (), "hidden", tuple(range(len(keys))))
    sizes = row[list(keys)].astype(np.float32)
    change = np.broadcast_to(sizes[:, None, None], (len(keys), 5, 7))
    one = ReplanMap(form, sizes, tuple(range(len(keys))), (False,) * len(keys), change)
    conditions = (Interventions("unchanged"), Interventions("noise", noise=NoiseChange(1)))
    items, zeros = (EffectItem("nothing"), EffectItem("noise")), np.zeros((2, 5, 7), np.float32)
    cut = {site.name: np.zeros((2, site.num_keys), np.float32)}
    return ReplanEffects(conditions, items, (1.0,) * 7, (0, 1), zeros, cut, map=one)


def without_states(scenes: Sequence[Scene]) -> list[Scene]:
    """The scenes, each in an initial state that no other shares."""
    return [replace(scene, start=replace(scene.start, initial_state_digest="")) for scene in scenes]


def claims(path: Path, maps: bool = False) -> bool:
    """Whether a sentence of the first screen of `objects` says that what is named gets more, or less.

    maps: one of `effects`, that it moves the action more, or less.
    """
    if maps:
        named = [finding for finding in va.open(path).effects().findings if finding.asks == ASKS_NAMED]
        return bool(named and named[0].numbers["shown"])
    return any(finding.numbers.get("shown") and "form" in finding.numbers
               for finding in va.open(path).objects(iou=False).findings)  # fmt: skip


def share_of(stores: int, make: Callable[[int, Path], Path], maps: bool = False) -> float:
    """In which share of so many stores something is claimed."""
    found = 0
    for number in range(stores):
        with tempfile.TemporaryDirectory() as folder:
            found += claims(make(number, Path(folder) / "a.zarr"), maps)
    return found / stores


def thrice(root: RootAttributes, scenes: Sequence[Scene], number: int, path: Path) -> Path:
    """The first episode of each task three times, with the same rows."""
    first = {scene.start.task_id: scene for scene in reversed(scenes)}
    copies = [replace(one, start=replace(one.start, episode_index=i)) for one in first.values() for i in range(3)]
    rows = [rows_of(first[one.start.task_id], root, FOLLOWS["one kind always"], number, 1.0) for one in copies]
    return write(path, root, copies, rows)


def over_places(path: Path) -> Array:
    """What `objects` prints as over its place, of every object."""
    return va.open(path).objects(iou=False)["objects"]["over_place"].drop_nulls().to_numpy()


def like_libero(suite: str, seed: int) -> tuple[RootAttributes, list[Scene]]:
    """Ten tasks of three episodes: in "spatial" a bowl and a plate are always named, in "object" another thing each.

    Things stand where the task says, and a little elsewhere in each episode; in "object" what is named stands at the
    same place in all tasks.
    """
    layout = site_layout({"base_0_rgb": (8, 8)}, 4, text_keys=14, action_keys=5)
    names = [f"thing_{chr(97 + i)}_1" for i in range(10)]
    generator, scenes = np.random.default_rng([seed, 5]), []
    for task in range(10):
        if suite == "spatial":
            named, there = ["black_bowl_1", "plate_1"], ["black_bowl_1", "black_bowl_2", "plate_1", "ramekin_1"]
        else:
            others = generator.permutation([name for name in names if name != names[task]])[:4]
            named, there = [names[task], "basket_1"], [names[task], "basket_1", *map(str, others)]
        places = generator.permutation([9, 12, 27, 30, 45, 48, 50])[: len(there)]
        places[0] = 18 if suite == "object" else places[0]
        objects = (*(SceneObject(name, "object", name in named) for name in there),
                   SceneObject("background", "background", False))  # fmt: skip
        for episode in range(3):
            area = np.zeros((REPLANS, 64, len(objects)), np.float32)
            for i, place in enumerate(places):
                area[:, place, i], part = 0.8, int(generator.choice([-8, -1, 1]))
                area[:, place + part, i] = generator.uniform(0.1, 0.6)
            area /= np.maximum(area.sum(-1, keepdims=True), 1.0)
            area[..., -1] = 1.0 - area[..., :-1].sum(-1)
            prompt, text = small_prompt(layout, f"pick up {named[0]}", "1 2")
            roles = np.full((REPLANS, layout.num_keys), Role.IMAGE, np.uint8)
            roles[:, layout.span("prompt").start : layout.span("prompt").stop] = text
            roles[:, layout.span("actions").start :] = Role.ACTION
            start = EpisodeStart(task, f"task_{task}", f"pick up {named[0]}", episode, episode, f"{task}-{episode}",
                                 objects, {}, "" if suite == "spatial" else "pick up the THING")  # fmt: skip
            scenes.append(Scene(start, prompt, roles, {"base_0_rgb": area}, {}, there[0]))
    root = root_attributes(StoreSpec(layers=(0,), heads=(0,), denoise_steps=(9,), frames=False))
    return structs.replace(
        root, sites=(layout,), policy=structs.replace(root.policy, cameras=root.policy.cameras[:1])
    ), scenes


def kinds(store: Path, maps: bool = False) -> Iterator[tuple[str, Callable[[int, Path], Path]]]:
    """Name of a kind of stores, and what writes the store of a number to a path; no two kinds share their noise."""
    root, shared = scenes_of(store)

    def made(scenes: Sequence[Scene], name: str, planted: float = 1.0) -> Callable[[int, Path], Path]:
        first = 10_000 * (1 + list(FOLLOWS).index(name) + len(FOLLOWS) * (planted > 1))
        return lambda number, path: write(
            path, root, scenes, [rows_of(scene, root, FOLLOWS[name], first + number, planted) for scene in scenes], maps
        )

    for states, scenes in (("same states", shared), ("other tasks", without_states(shared))):
        for name in FOLLOWS:
            yield f"{name}, {states}", made(scenes, name)
        if maps:
            yield f"PLANTED: named twice, uniform, {states}", made(scenes, "uniform", PLANTED)
            return
        yield f"thrice, {states}", lambda number, path, scenes=scenes: thrice(root, scenes, number, path)
        for name in ("uniform", "every cube alike"):
            yield f"PLANTED: named twice, {name}, {states}", made(scenes, name, PLANTED)
    for suite in ("spatial", "object"):
        for planted in (1.0, PLANTED):

            def of_libero(number: int, path: Path, suite: str = suite, planted: float = planted) -> Path:
                own, scenes = like_libero(suite, number)
                kind = "black_bowl" if suite == "spatial" else f"thing_{chr(97 + number % 10)}"

                def follow(scene: Scene, camera: str, seed: int) -> Array:
                    of_kind = [scene.of(name, camera) for name in _names(scene) if name.startswith(kind)]
                    return np.minimum(np.sum([np.zeros(scene.coverage[camera].shape[:2]), *of_kind], axis=0), 1.0)

                return write(path, own, scenes, [rows_of(scene, own, follow, number, planted) for scene in scenes])

            yield f"{'PLANTED: ' if planted > 1 else ''}one kind always, as libero_{suite}", of_libero


def main() -> None:
    """Print a line per kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stores", type=int, default=100, help="stores of each kind (default: 100)")
    parser.add_argument("--store", type=Path, help="a run of cubes (default: the shipped example)")
    parser.add_argument("--only", default="", help="kinds whose name has this")
    parser.add_argument("--maps", action="store_true", help="of maps of patches, as large as the attention would be")
    arguments = parser.parse_args()
    for name, make in kinds(arguments.store or va.example("cubes"), arguments.maps):
        if arguments.only in name:
            print(f"{name:56} {100 * share_of(arguments.stores, make, arguments.maps):5.1f} %", flush=True)


if __name__ == "__main__":
    main()
