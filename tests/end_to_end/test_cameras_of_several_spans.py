"""A camera of several spans (grids, tiles, pooled tokens) is one camera: groupings, maps, objects, knock-outs."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import vla_attention as va
from tests.capture.torch_policies.test_session_knockouts import act_recorded
from tests.kit.examples import examples
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from tests.kit.small_torch_policy import HORIZON, SmallPolicy, small_layout
from tests.kit.small_torch_policy import given as policy_inputs
from tests.kit.stores import StoreSpec, write_store
from tests.kit.strategies import episode_tokens
from tests.kit.tokens import OBJECTS, small_prompt, tokens_of
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.objects import objects
from vla_attention.analyze.core.camera_maps import PictureMap
from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.interventions.changed_inputs import CallContext, changed_picture, patch_pixels
from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.errors import BadArgument, Note
from vla_attention.schemas.groupings.builtin_groupings import BUILTIN_GROUPINGS
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject, collect_vocabulary
from vla_attention.schemas.interventions import ImageChange
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout, Span, camera_grids
from vla_attention.schemas.stores.reader import open_store

WHOLE, TOP, LEFT = (0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 0.5, 1.0), (0.0, 0.0, 1.0, 0.5)


def weights(tokens: EpisodeTokens, selector: str) -> np.ndarray:
    grouping = Grouping("one", {"one": (selector,)}, allow_empty=("one",))
    return np.asarray(resolve(grouping, tokens).weights[:, :, 0])


def keys_of(layout: SiteLayout, camera: str) -> list[int]:
    return [key for span in layout.spans if span.camera == camera for key in range(span.start, span.stop)]


@given(data=st.data())
@settings(max_examples=examples(30))
def test_everything_that_goes_by_camera_takes_all_its_keys(data):
    tokens = data.draw(episode_tokens())
    layout, image = tokens.layout, tokens.key_role == Role.IMAGE
    vocabulary = collect_vocabulary([tokens])
    default, cameras = (BUILTIN_GROUPINGS[name](vocabulary) for name in ("default", "cameras"))
    visual, by_camera = resolve(default, tokens), resolve(cameras, tokens)
    of_cameras = np.zeros_like(visual.weights[..., 0])
    for camera in layout.cameras:
        keys = keys_of(layout, camera)
        assert np.flatnonzero(weights(tokens, f"camera:{camera}")[0]).tolist() == keys
        if camera in vocabulary.cameras:
            own = by_camera.weights[..., by_camera.names.index(camera)]
            np.testing.assert_array_equal(np.flatnonzero(own[0]), [key for key in keys if image[0, key]])
            of_cameras = of_cameras + own
        grids = [span for span in layout.spans if span.camera == camera and span.grid is not None]
        region = data.draw(st.tuples(*[st.integers(0, 7)] * 2, *[st.integers(1, 8)] * 2))
        (r0, c0), (r1, c1) = region[:2], (min(8, region[0] + region[2]), min(8, region[1] + region[3]))
        inside = []
        for span in grids:
            top, left, height, width = span.grid.part
            for patch in range(span.num_keys):
                row, column = divmod(patch, span.grid.columns)
                at = (row + 0.5) / span.grid.rows * height + top, (column + 0.5) / span.grid.columns * width + left
                if r0 <= 8 * at[0] < r1 and c0 <= 8 * at[1] < c1:
                    inside.append(span.start + patch)
        taken = weights(tokens, f"patch:{camera}[{r0 / 8}:{r1 / 8},{c0 / 8}:{c1 / 8}]")
        assert np.flatnonzero(taken[0]).tolist() == inside
        if len(grids) > 1:
            with pytest.raises(SelectorError, match=f"{len(grids)} grids"):
                weights(tokens, f"patch:{camera}[0:1,0:1]")
            assert weights(tokens, f"patch:{camera}[:,:]").sum() == len(layout.patch_keys(camera))
        if tokens.coverage and camera in tokens.coverage:
            covered = weights(tokens, "object:plate_1")[:, layout.patch_keys(camera)]
            np.testing.assert_allclose(covered, tokens.coverage[camera][..., 1], rtol=1e-6)
    reference = resolve(BUILTIN_GROUPINGS["reference"](vocabulary), tokens)
    first = next(span.camera for span in layout.spans if span.camera is not None)
    assert np.flatnonzero(reference.weights[0, :, 0]).tolist() == list(range(len(keys_of(layout, first))))
    np.testing.assert_array_equal(of_cameras, visual.weights[..., visual.names.index("visual")])


@given(data=st.data())
@settings(max_examples=examples(30))
def test_a_map_sums_to_the_mass_of_all_patches_each_where_it_lies(data):
    layout = data.draw(episode_tokens()).layout
    for camera in layout.pictured:
        picture = PictureMap.of(layout, camera)
        mass = np.random.default_rng(data.draw(st.integers(0, 99))).random((2, layout.num_keys))
        found = picture.spread(mass[:, picture.keys])
        expected, highest, first = np.zeros_like(found), np.zeros_like(found), 0
        for span in (span for span in layout.spans if span.camera == camera and span.grid is not None):
            top, left, height, width = span.grid.part
            for patch in range(span.num_keys):
                row, column = divmod(patch, span.grid.columns)
                sides = []
                for number, start, length, count, cells in (
                    (row, top, height, span.grid.rows, picture.rows),
                    (column, left, width, span.grid.columns, picture.columns),
                ):
                    begin, end = start + number * length / count, start + (number + 1) * length / count
                    edges = np.arange(cells + 1) / cells
                    both = np.minimum(end, edges[1:]) - np.maximum(begin, edges[:-1])
                    middle = (edges[1:] + edges[:-1]) / 2
                    sides.append((np.clip(both, 0, None) / (end - begin), (begin <= middle) & (middle < end)))
                (down, at_row), (across, at_column) = sides
                expected += mass[:, span.start + patch, None, None] * np.outer(down, across)
                inside = np.outer(at_row, at_column) * mass[:, span.start + patch, None, None]
                highest = np.maximum(highest, inside)
            first += span.num_keys
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.sum(axis=(1, 2)), mass[:, picture.keys].sum(axis=1))
        if len(picture.grids) == 1 or all(picture.rows % grid.rows == 0 for grid in picture.grids):
            assert (picture.highest(mass[:, picture.keys]) <= highest.max() + 1e-12).all()


def spans_of(parts: list[tuple[str, PatchGrid | None]]) -> SiteLayout:
    """Spans of the camera `front` (`pooled` of two keys) with the prompt in their middle, and another camera."""
    wrist = PatchGrid(2, 2, 16, 16)
    named = [(name, "image", grid.num_patches if grid else 2, "front", grid) for name, grid in parts]
    named.insert(1, ("prompt", "text", 14, None, None))
    named += [("wrist", "image", 4, "wrist", wrist), ("actions", "action", 5, None, None)]
    spans, start = [], 0
    for name, kind, length, camera, grid in named:
        spans.append(Span(name, kind, start, start + length, camera, grid))
        start += length
    return SiteLayout("joint", tuple(spans))


KINDS = {
    "pooled beside": [("patches", PatchGrid(3, 4, 12, 16)), ("pooled", None)],
    "tiles and thumbnail": [
        ("left", PatchGrid(4, 2, 16, 16, LEFT)),
        ("right", PatchGrid(4, 2, 16, 16, (0.0, 0.5, 1.0, 0.5))),
        ("small", PatchGrid(2, 2, 16, 16)),
        ("pooled", None),
    ],
    "two frames": [("now", PatchGrid(3, 4, 12, 16)), ("before", PatchGrid(3, 4, 12, 16))],
    "a part only": [("top", PatchGrid(2, 4, 16, 16, TOP))],
}


def write_spans_store(path: Path, kind: str) -> tuple[Path, SiteLayout]:
    """A store whose camera `front` has the spans of a kind, and its layout."""
    layout = spans_of(KINDS[kind])
    generator = np.random.default_rng(3)
    prompts = [small_prompt(layout, "put the bowl on the plate", "1 2") for _ in range(3)]
    coverage = {
        camera: generator.dirichlet(np.full(len(OBJECTS), 0.3), (3, len(layout.patch_keys(camera)))).astype(np.float32)
        for camera in layout.cameras
    }
    spec = StoreSpec(tasks=(0,), episodes=2, tokens=tokens_of(layout, prompts, OBJECTS, coverage))
    return write_store(path, spec=spec), layout


@pytest.fixture(scope="module", params=KINDS)
def made(request, tmp_path_factory):
    return write_spans_store(tmp_path_factory.mktemp("spans") / "a.zarr", request.param)


def raw(path) -> np.ndarray:
    """Rows of the first episode, mean over layers, steps, heads and queries: (replan, key)."""
    rows = probabilities(zarr.open_group(path / "episodes/task000_episode000", mode="r")["joint/rows"])
    return rows.astype(np.float64).mean(axis=(1, 2, 3, 4))


def test_masses_and_overlay_of_a_store_are_of_all_keys(made, tmp_path, capsys):
    path, layout = made
    rows, keys = raw(path), keys_of(layout, "front")
    masses = va.open(path).analyze(grouping="cameras")["episodes_groups"].filter(pl.col("episode_index") == 0)
    own = masses.filter((pl.col("group") == "front") & (pl.col("layer") == "layers_avg"))
    np.testing.assert_allclose(own["mass"], rows[:, keys].sum(axis=1).mean(), rtol=1e-4)
    words = ["--replans", "0", "2", "--outline", "f=camera:front"]
    assert main(["overlay", str(path), "--output", str(tmp_path), *words]) == 0
    table = pl.read_parquet(tmp_path / "overlay_patches.parquet").filter(pl.col("camera") == "front")
    placed = [
        key for span in layout.spans if span.camera == "front" and span.grid for key in range(span.start, span.stop)
    ]
    for replan in (0, 2):
        own = table.filter(pl.col("replan") == replan)
        np.testing.assert_allclose(own["mass"].sum(), rows[replan, placed].sum(), rtol=1e-5)
        image = rows[replan, [*keys, *keys_of(layout, "wrist")]].sum()
        np.testing.assert_allclose(own["share"].sum(), rows[replan, placed].sum() / image, rtol=1e-5)
    printed = " ".join(capsys.readouterr().out.split())
    beside = [key for key in keys if key not in placed]
    names = [span.name for span in layout.camera_spans("front") if span.grid is not None]
    assert ("map of front" in printed) == (len(names) > 1 or bool(beside))
    assert (f"attention on {', '.join(names)}" in printed) == (len(names) > 1)
    outside = 100 * rows[:, beside].sum() / rows[:, keys].sum()
    assert (f"{outside:.1f}% of" in printed) == bool(beside)


@pytest.mark.parametrize("made", ["tiles and thumbnail"], indirect=True)
def test_its_groups_and_its_report_are_drawn(made, tmp_path):
    path, _ = made
    assert main(["analyze", str(path), "--list", "--grouping", "cameras", "--output", str(tmp_path)]) == 0
    assert main(["report", str(path), "--output", str(tmp_path / "report.html")]) == 0


def test_runs_whose_spans_are_of_other_cameras_are_not_compared(tmp_path, capsys):
    layout = spans_of(KINDS["pooled beside"])
    other = replace(layout, spans=tuple(replace(s, camera=None) if s.name == "pooled" else s for s in layout.spans))
    for name, one in (("a", layout), ("b", other)):
        tokens = tokens_of(one, [small_prompt(one, "put the bowl on the plate", "1 2")])
        write_store(tmp_path / f"{name}.zarr", spec=StoreSpec(tokens=tokens))
    assert main(["compare", *(str(tmp_path / f"{name}.zarr") for name in "ab"), "--output", str(tmp_path / "c")]) == 2
    assert "keys 26-27 of camera front" in " ".join(capsys.readouterr().err.split())


def test_objects_of_a_camera_are_measured_on_all_its_patches(made):
    path, layout = made
    tables = objects(question_about(path))
    group = zarr.open_group(path / "episodes/task000_episode000", mode="r")
    covered, rows = np.asarray(group["objects/front"], np.float64), raw(path)[:, layout.patch_keys("front")]
    own = tables["objects_episodes"].filter(
        (pl.col("camera") == "front") & (pl.col("episode_index") == 0) & (pl.col("layer") == "layers_avg")
    )
    for number, thing in enumerate(OBJECTS):
        row = own.filter((pl.col("kind") == "object") & (pl.col("item") == thing.name))
        np.testing.assert_allclose(row["mass"], (rows * covered[..., number]).sum(axis=1).mean(), rtol=2**-10)
        np.testing.assert_allclose(row["area_share"], covered[..., number].mean(), rtol=1e-5)
    rows = tables["pointing_episodes"].filter(pl.col("camera") == "front")["centre_row"]
    assert rows.is_between(0, PictureMap.of(layout, "front").rows).all()


PARTS = (
    Span("tile_top", "image", 0, 2, "front", PatchGrid(1, 2, 8, 8, TOP)),
    Span("tile_bottom", "image", 2, 4, "front", PatchGrid(1, 2, 8, 8, (0.5, 0.0, 0.5, 1.0))),
)


def policy_layout():
    """`SmallPolicy` with its picture in two tiles, and its state's key as a token that was pooled over the picture."""
    spans = (
        *PARTS,
        Span("prompt", "text", 4, 10),
        Span("pooled", "image", 10, 11, "front"),
        Span("actions", "action", 11, 14),
    )
    roles = {
        "prompt": "instruction",
        "actions": "action",
        **dict.fromkeys(("tile_top", "tile_bottom", "pooled"), "image"),
    }
    site = RecordedSite(SiteLayout("joint", spans), (0, HORIZON), roles)
    return small_layout(sites=(site,))


def test_a_knock_out_of_a_camera_hides_every_key(tmp_path):
    store, _ = act_recorded(tmp_path, SmallPolicy(), layout=policy_layout(), interventions=va.knockout("camera:front"))
    rows = store.episodes[0].read("joint/rows")
    assert (rows[..., [0, 1, 2, 3, 10]] == 0).all()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-3)


def test_effects_of_a_camera_cut_every_key(tmp_path):
    policy = SmallPolicy()
    with (
        warnings.catch_warnings(),
        record(
            tmp_path / "a.zarr",
            policy,
            layout=policy_layout(),
            tokenizer=policy.tokenizer,
            durable=False,
            effects=EffectSettings(("cameras",), ("action",)),
        ) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
        episode.replan(env_step=0, repeat=lambda call: policy.act(**policy_inputs())) as replan,
    ):
        warnings.simplefilter("ignore", Note)  # the made-up noise is none of a known generator
        replan.actions = policy.act(**policy_inputs())
    episode = open_store(tmp_path / "a.zarr").episodes[0]
    effects = episode.attributes.effects
    of_camera = [
        any(edit.selector == "camera:front" for edit in effects.conditions[number].keys) for number in effects.condition
    ]
    (cut,) = episode.read("joint/cut")[of_camera]
    assert np.flatnonzero(cut).tolist() == [0, 1, 2, 3, 10]


def test_masks_of_a_picture_cover_the_patches_of_its_tiles(tmp_path):
    policy, mask = SmallPolicy(), np.random.default_rng(0).integers(0, 2, (8, 8))
    things = (SceneObject("bowl_1", "object", True), SceneObject("background", "background", False))
    with (
        record(tmp_path / "a.zarr", policy, layout=policy_layout(), tokenizer=policy.tokenizer, durable=False) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl", objects=things) as episode,
        episode.replan(env_step=0, masks={"front": mask}, frames={"front": np.zeros((8, 8, 3), np.uint8)}) as replan,
    ):
        replan.actions = policy.act(**policy_inputs())
    covered = open_store(tmp_path / "a.zarr").episodes[0].read("objects/front")[0]
    squares = [mask[r : r + 4, c : c + 4] for r in (0, 4) for c in (0, 4)]
    np.testing.assert_allclose(covered[:, 1], [square.mean() for square in squares], rtol=1e-6)


@pytest.mark.parametrize(
    "part",
    [
        (0, 0, 448, 448),
        (0.5, 0.0, 0.6, 1.0),
        (-0.1, 0, 0.5, 0.5),
        (0, 0, 0.0, 1),
        (0, 0, float("nan"), 1),
        (0, 1),
        None,
        "all",
    ],
)
def test_a_part_that_is_none_of_the_picture_is_refused(part):
    with pytest.raises(BadArgument, match=r"\(top, left, height, width\)"):
        PatchGrid(2, 2, 8, 8, part)
    assert PatchGrid(2, 2, 8, 8, [0, 0, 1, 1]) == PatchGrid(2, 2, 8, 8)
    assert len({PatchGrid(2, 2, 8, 8, np.array([0, 0.5, 1, 0.5])), PatchGrid(2, 2, 8, 8, (0.0, 0.5, 1.0, 0.5))}) == 1


def test_a_map_of_several_grids_has_a_limited_number_of_cells():
    keys = 2**16
    spans = (
        Span("a", "image", 0, keys, "front", PatchGrid(keys, 1, 1000, 1000)),
        Span("b", "image", keys, keys + 1, "front", PatchGrid(1, 1, 8, 8, (0.5, 0.5, 0.125, 0.125))),
    )
    with pytest.raises(BadArgument):
        SiteLayout("joint", spans)
    small = replace(spans[1], grid=PatchGrid(1, 1, 1000, 1000, (0.5, 0.5, 0.001, 0.001)))
    picture = PictureMap.of(SiteLayout("joint", (spans[0], small)), "front")
    assert (picture.rows, picture.columns) == (128, 128)
    np.testing.assert_allclose(picture.spread(np.ones(keys + 1)).sum(), keys + 1)


def test_grids_of_pictures_of_two_sizes_are_refused_in_one_site_and_in_two():
    small, large = (Span("a", "image", 0, 4, "front", PatchGrid(2, 2, side, side)) for side in (8, 16))
    with pytest.raises(BadArgument, match=r"8 x 8, 16 x 16 .*part="):
        SiteLayout("joint", (small, replace(large, name="b", start=4, stop=8)))
    sites = [RecordedSite(SiteLayout(*one), (0, 3), {"a": "image"}) for one in (("one", (small,)), ("two", (large,)))]
    with pytest.raises(BadArgument, match="8 x 8, 16 x 16 pixels"):
        small_layout(sites=tuple(sites))


def test_what_counts_patches_of_one_grid_refuses_several():
    sites = [SiteLayout("one", PARTS), SiteLayout("two", (Span("a", "image", 0, 4, "front", PatchGrid(2, 2, 8, 8)),))]
    with pytest.raises(BadArgument, match="'front'"):
        camera_grids(sites, "front")
    context = CallContext(0, 0, 0)
    with pytest.raises(BadArgument, match="grid"):
        changed_picture(np.zeros((8, 8, 3), np.uint8), ImageChange("front", "shifted", rows=1), sites[:1], context)
    patches = np.array([True, False, False, True])
    expected = np.kron(patches.reshape(2, 2), np.ones((4, 4), dtype=bool))
    np.testing.assert_array_equal(patch_pixels(patches, sites[0].grids("front"), (8, 8, 3)), expected)
