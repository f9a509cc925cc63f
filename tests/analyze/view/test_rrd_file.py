"""`vla-attention view --rrd`: what is logged, and what Rerun's own reader finds of it, against store and analysis."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from PIL import Image

import vla_attention as va
from tests.kit.archives import example_store
from tests.kit.planted_effects import planted_effects
from tests.kit.site_stores import write_site_store
from tests.kit.stores import StoreSpec, small_steps, write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.core.action_changes import units_of
from vla_attention.analyze.view import rrd_file
from vla_attention.analyze.view.episode_answers import ShownEpisode
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.stores.reader import StoredEpisode, open_store


def gone_in_call_1(_task: int, _episode: int, tokens: EpisodeTokens) -> dict[str, np.ndarray]:
    """`PlantCoverage`: random; in the second call there is background alone."""
    found = {camera: coverage.copy() for camera, coverage in tokens.coverage.items()}
    for coverage in found.values():
        coverage[1] = [thing.kind == "background" for thing in tokens.objects]
    return found


SPEC = StoreSpec(
    tasks=(0, 1),
    replans=4,  # the touch, in the middle, is where a call begins
    plant_effects=planted_effects(),
    plant_steps=small_steps,
    plant_coverage=gone_in_call_1,
)


def test_a_library_that_is_missing_or_too_old_is_named(tmp_path, capsys, monkeypatch):
    store = write_store(tmp_path / "a.zarr", spec=replace(SPEC, tasks=(0,), episodes=1))
    for library in (None, SimpleNamespace(__version__="0.23.4")):
        monkeypatch.setitem(sys.modules, "rerun", library)
        assert main(["view", str(store), "--rrd", str(tmp_path / "a.rrd")]) == 2
        said = capsys.readouterr().err
        assert install_line("rerun") in said
        assert ("0.23.4" in said) == (library is not None)
    assert not (tmp_path / "a.rrd").exists()
    assert main(["view", str(store), "--rrd", str(tmp_path / "b.zarr")]) == 2
    assert "b.zarr" in capsys.readouterr().err


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("recorded") / "a.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def rerun() -> Any:
    return pytest.importorskip("rerun", reason="rerun-sdk is half a gigabyte: make test-rerun")


Recording = dict[str, dict[str, dict[int | None, Any]]]


def read_again(path: Path) -> Recording:
    """Entity -> column -> step (None: throughout) -> what was logged there; Rerun's reader has read it.

    The column `call` is the place on the other time line.
    """
    reader = pytest.importorskip("rerun.chunk", reason="only newer releases of rerun-sdk have this reader")
    found: Recording = {}
    for chunk in reader.RrdReader(path).stream().to_chunks():
        read = chunk.to_record_batch()
        batch = {name: read.column(name).to_pylist() for name in read.schema.names if name != "log_time"}
        steps = batch.pop("step", [None] * chunk.num_rows)
        for name, values in batch.items():
            column = found.setdefault(chunk.entity_path.replace("\\", ""), {}).setdefault(name, {})
            column.update((step, value) for step, value in zip(steps, values, strict=True) if value is not None)
    return found


def as_logged(path: Path, name: str) -> Recording:
    """The same of what is given to Rerun: a value is a list, as a reader has it, unless it is one already."""
    store, found = open_store(path), Recording()
    (episode,) = [one for one in store.episodes if one.name == name]
    shown = ShownEpisode(store, episode)
    units = units_of([store]) if episode.attributes.effects else None
    effects = [] if units is None else rrd_file.shown_effects(shown, units)
    about = shown.about()
    for one in rrd_file.logged(shown, about, effects, units):
        columns, many = found.setdefault("/" + "/".join(one.place), {}), isinstance(one.steps, Sequence)
        for field, values in one.values.items():
            column = columns.setdefault(f"{one.kind}:{field}", {})
            if many:
                column.update((step, [value]) for step, value in zip(one.steps, values, strict=True))
            else:
                column[one.steps] = values if field in ("strips", "colors", "labels", "class_ids") else [values]
        if one.steps is not None:
            (_, steps), (name, calls) = one.times(about["starts"]).items()
            columns.setdefault(name, {}).update(zip(steps, calls, strict=True) if many else {steps: calls})
    return found


@pytest.fixture(scope="module", params=["logged", "read"])
def recording(request, store, tmp_path_factory) -> Recording:
    if request.param == "logged":
        return as_logged(store, "task001_episode000")
    request.getfixturevalue("rerun")
    path = tmp_path_factory.mktemp("recorded") / "one.rrd"
    assert main(["view", str(store), "--rrd", str(path), "--task", "1", "--episode", "0"]) == 0
    return read_again(path)


@pytest.fixture
def episode(store) -> StoredEpisode:
    (found,) = [one for one in open_store(store).episodes if one.name == "task001_episode000"]
    return found


@pytest.fixture
def starts(store) -> list[int]:
    """Policy steps before each replan of the episode."""
    opened = open_store(store)
    (found,) = [one for one in opened.episodes if one.name == "task001_episode000"]
    return (found.read("env_step").astype(int) - opened.attributes.protocol.wait_steps).tolist()


def curves(recording, below: str) -> dict[str, dict[int, float]]:
    """Name -> step -> number, of the curves below an entity."""
    return {
        entity.removeprefix(f"/{below}/"): {step: value[0] for step, value in columns["Scalars:scalars"].items()}
        for entity, columns in recording.items()
        if entity.startswith(f"/{below}/")
    }


def by_step(frame: pl.DataFrame | pl.LazyFrame, value: str, starts: list[int]) -> dict[int, float]:
    """A column of the episode's rows of replans, by the step of the replan."""
    rows = frame.lazy().filter(task_id=1, episode_index=0).sort("replan").select("replan", value).collect()
    return {starts[replan]: number for replan, number in rows.iter_rows() if number is not None}


def test_ratio_masses_and_effects_are_those_of_the_analysis(store, recording, starts):
    tables = va.open(store).analyze(by="replan")
    averages = tables["replans"].lazy().filter(layer="layers_avg")
    ratio = curves(recording, "ratio")
    assert ratio["ratio"] == pytest.approx(by_step(averages, "ratio", starts))
    assert ratio["spread evenly"] == pytest.approx(by_step(averages, "uniform_ratio", starts))
    groups = tables["replans_groups"].lazy().filter(layer="layers_avg")
    masses = curves(recording, "masses")
    assert {"visual", "linguistic"} < masses.keys()
    for name, values in masses.items():
        assert values == pytest.approx(by_step(groups.filter(group=name), "mass", starts))
    # In units of the whole store: of one episode's actions they would be others.
    effects = va.open(store).effects()["effects"].lazy().filter(kind="without", reader="total")
    words = curves(recording, "effects/word")
    assert len(words) > 1
    for name, values in words.items():
        assert values == pytest.approx(by_step(effects.filter(label=name), "effect", starts))


def test_words_have_what_their_keys_get_over_even_attention(store, recording, starts):
    frame = va.open(store).overlay(episode=0, tasks=[1]).figures[0].frame
    for row in frame.iter_rows(named=True):
        step = starts[row["replan"]]
        table = recording["/words"]["TextDocument:text"][step][0]
        assert [line.split("|")[1].strip() for line in table.splitlines()[2:]] == row["words"]
        shown = {word: values[step] for word, values in curves(recording, "attention").items() if step in values}
        assert sorted(shown.values()) == pytest.approx(sorted(row["lifts"]))
    assert frame.height


def test_a_word_with_a_capital_letter_has_its_effect_and_one_that_comes_twice_a_number():
    effects = [{"item": "lift", "kind": "without", "item_kind": "word", "effect": [0.5]}]
    words = [("Lift", 2.0), ("it", 1.0), ("it", 3.0)]
    table, *series = rrd_file._words((), SimpleNamespace(words=[words]), effects, [0])
    assert table.values["text"].splitlines()[2] == "| Lift | 2.00 | 0.50 |"
    assert [one.place[-1] for one in series if one.kind == "Scalars"] == ["Lift", "it", "it (2)"]


def test_a_full_disk_ends_it_and_leaves_nothing(tmp_path, store, rerun):
    view = [sys.executable, "-m", "vla_attention", "view", str(store), "--rrd", str(tmp_path / "a.rrd")]
    done = subprocess.run(["sh", "-c", 'ulimit -f 64; exec "$@"', "sh", *view], capture_output=True, text=True)
    assert (done.returncode, str(tmp_path) in done.stderr) == (2, True)
    assert not [*tmp_path.iterdir()]


def borders_of(inside: np.ndarray, shape: tuple[int, ...]) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """The sides (x, y) to (x, y) of patches in pixels that part one inside from one outside."""
    wide, high = shape[1] / inside.shape[1], shape[0] / inside.shape[0]
    padded, found = np.pad(inside, 1), []
    for row, column in np.ndindex(padded.shape[0] - 1, padded.shape[1] - 1):
        corner, here = (round(column * wide, 3), round(row * high, 3)), padded[row + 1, column + 1]
        if here != padded[row + 1, column]:
            found.append((corner, (corner[0], round((row + 1) * high, 3))))
        if here != padded[row, column + 1]:
            found.append((corner, (round((column + 1) * wide, 3), corner[1])))
    return found


def test_pictures_are_the_stored_ones_and_lines_go_around_what_gets_twice_even(store, episode, recording, starts):
    hold_pictures(store, episode, recording, starts)


def test_pictures_and_outlines_of_a_mirrored_camera_and_the_mark_of_what_is_named():
    path = example_store("cubes")
    (episode,) = [one for one in open_store(path).episodes if one.name == "task001_episode000"]
    assert any(camera.mirrored for camera in open_store(path).attributes.policy.cameras)
    steps = episode.read("env_step").astype(int)
    recording = as_logged(path, episode.name)
    hold_pictures(path, episode, recording, (steps - steps[0]).tolist())
    hold_outlines(path, episode, recording, (steps - steps[0]).tolist())
    marks = {entity: columns["Boxes3D:class_ids"][None] for entity, columns in recording.items() if "/mark" in entity}
    labels = {entity: classes_of(recording)[number][0] for entity, [number] in marks.items()}
    assert labels == {
        "/scene/red cube/mark": "red cube",
        "/scene/green cube/mark": "green cube (named)",
        "/scene/blue cube/mark": "blue cube",
    }


def test_outlines_go_around_the_patches_of_named_and_touched_objects(store, episode, recording, starts):
    hold_outlines(store, episode, recording, starts)


def test_what_was_touched_though_another_was_named_has_a_class_of_its_own_colour():
    path = example_store("cubes_one_colour")
    store = open_store(path)
    (one,) = [one for one in store.episodes if one.attributes.steps.touched == ("blue_cube",)][:1]
    recording = as_logged(path, one.name)
    assert ShownEpisode(store, one).named == {"red_cube"}
    assert dict(classes_of(recording).values())["blue cube (touched)"] == (0xFF, 0x6A, 0x1F)
    steps = one.read("env_step").astype(int)
    hold_outlines(path, one, recording, (steps - steps[0]).tolist())


def classes_of(recording: Recording) -> dict[int, tuple[str, tuple[int, int, int]]]:
    """Number -> label and colour of Rerun's classes."""
    ((classes,),) = recording["/"]["AnnotationContext:context"].values()
    if isinstance(classes[0], tuple):
        return {number: (label, color) for number, label, color in classes}
    read = [one["class_description"]["info"] for one in classes]
    return {one["id"]: (one["label"], tuple(one["color"].to_bytes(4, "big")[:3])) for one in read}


def hold_outlines(store: Path, episode: StoredEpisode, recording: Recording, starts: list[int]) -> None:
    """Rays from the left cross an object's outline an odd number of times on their way to the cells that it covers."""
    shown, classes = ShownEpisode(open_store(store), episode), classes_of(recording)
    assert [label.split(" (")[0] for label, _ in classes.values()] == [
        thing.name.replace("_", " ") for thing in episode.attributes.objects
    ]
    touched = {*episode.attributes.steps.touched}
    numbers = {thing.name: number for number, thing in enumerate(episode.attributes.objects)}
    drawn = 0
    for camera, how in shown.about()["sites"]["joint"]["cameras"].items():
        sides = np.array([how["width"], how["height"]]) / (how["columns"], how["rows"])
        for name, cells in shown.covered("joint").get(camera, {}).items():
            columns = recording.get(f"/pictures/{camera}/objects/{name.replace('_', ' ')}")
            assert (columns is not None) == (name in shown.named | touched)
            for replan, step in enumerate(starts) if columns else ():
                assert columns["LineStrips2D:class_ids"][step] == [numbers[name]]
                own = columns["LineStrips2D:strips"].get(step, [])
                inside = []
                for row, column in np.ndindex(how["rows"], how["columns"]):
                    x, y = (np.array([column, row]) + 0.5) * sides
                    crossed = [a for a, b in own if a[0] == b[0] < x and min(a[1], b[1]) < y < max(a[1], b[1])]
                    inside += [row * how["columns"] + column] * (len(crossed) % 2)
                assert inside == cells[replan]
                drawn += len(inside)
    assert drawn


def test_the_head_that_looks_most_is_that_of_the_grid(store, episode, recording, starts):
    shown = ShownEpisode(open_store(store), episode)
    target = shown.targets("joint")[0]
    assert target["name"].endswith("(named)")
    grid, most = shown.grid("joint", target["selector"]), curves(recording, "heads")["most"]
    lifts = np.array(grid["lift"], dtype=float)
    said = {step: text for step, [text] in recording["/heads/most"]["TextLog:text"].items()}
    assert most.keys() == {*starts} - {starts[1]}
    assert said[starts[1]] == f"out of sight: {target['name']}"
    for replan in (0, 2, 3):
        highest = most[starts[replan]]
        assert highest == lifts[replan].max()
        ((i,), (j,)) = np.nonzero(lifts[replan] == highest)
        where = f"layer {grid['layers'][i]}, head {grid['heads'][j]}"
        assert said[starts[replan]] == f"{where}: {highest:.3g} times even on {target['name']}"


def test_no_head_looks_at_what_is_out_of_sight():
    grid = {"layers": [3, 5], "heads": [0, 1], "lift": [[[None, None], [None, None]], [[0.5, 1.0], [7.0, 7.0]]]}
    first, second, series, _look = rrd_file._heads(("self",), "red cube", grid, [0, 5])
    assert first.values["text"] == "out of sight: red cube"
    assert second.values["text"] == "layer 5, head 0: 7 times even on red cube"
    assert (series.place, series.steps, series.values) == (("self", "heads", "most"), [5], {"scalars": [7.0]})


def test_by_call_everything_stands_where_it_was_executed_and_poses_where_they_were_seen(episode, recording, starts):
    places = set()
    for entity, columns in recording.items():
        calls = columns.get("call", {})
        # An event stands at the end of the step that led to it, which may be where the next call begins.
        since = -1 if entity == "/events" else 0
        assert calls == {step: sum(start <= step + since for start in starts) - 1 for step in calls}
        times = [step for name, column in columns.items() if name != "call" for step in column if step is not None]
        assert calls.keys() == {*times}
        if "Transform3D:translation" in columns:
            order = columns.get("rerun.controls.RowId", {step: place for place, step in enumerate(calls)})
            shown = {calls[step]: step for step in sorted(calls, key=order.__getitem__)}  # the last of a call
            assert (len(calls), shown) == (episode.attributes.num_steps + 1, dict(enumerate(starts)))
        places |= {entity.split("/")[1]} if calls else set()
    assert places > {"pictures", "words", "ratio", "heads", "effects", "scene", "actions", "events"}


def hold_pictures(store: Path, episode: StoredEpisode, recording: Recording, starts: list[int]) -> None:
    frame = va.open(store).overlay(episode=0, tasks=[1]).figures[0].frame
    views = {view.name: view for view in open_store(store).attributes.policy.cameras}
    drawn = 0
    for row in frame.iter_rows(named=True):
        camera, step = row["camera"], starts[row["replan"]]
        columns = recording[f"/pictures/{camera}"]
        blob = (columns.get("EncodedImage:blob") or columns["EncodedImage:contents"])[step][0]
        stored = episode.read(f"frames/{camera}", row["replan"])
        down, across = (1 if views[camera].upright else -1), (-1 if views[camera].mirrored else 1)
        picture = np.asarray(Image.open(io.BytesIO(bytes(blob))))
        np.testing.assert_array_equal(picture, stored[::down, ::across])
        strips = recording[f"/pictures/{camera}/2 times even"]["LineStrips2D:strips"].get(step, [])
        found = sorted(tuple(sorted((round(float(x), 3), round(float(y), 3)) for x, y in strip)) for strip in strips)
        assert found == sorted(borders_of(np.array(row["map"]) >= 2, picture.shape))
        drawn += len(strips)
    assert drawn


def test_hand_objects_actions_and_events_are_those_of_the_steps(episode, recording):
    steps, poses = episode.attributes.steps, episode.read("steps/poses")
    for i, body in enumerate(steps.bodies):
        columns = recording[f"/scene/{body.replace('_', ' ')}"]
        for step, pose in enumerate(poses[:, i]):
            np.testing.assert_allclose(columns["Transform3D:translation"][step][0], pose[:3], rtol=1e-6)
            x, y, z, w = columns["Transform3D:quaternion"][step][0]
            np.testing.assert_allclose((w, x, y, z), pose[3:], rtol=1e-6, atol=1e-7)
    actions = curves(recording, "actions")
    for name, executed in zip(
        ("x", "y", "z", "turn x", "turn y", "turn z", "gripper"), episode.read("steps/actions").T, strict=True
    ):
        assert actions[name] == pytest.approx(dict(enumerate(executed.tolist())))
    events = {step: text[0] for step, text in recording["/events"]["TextLog:text"].items()}
    assert events[steps.first_touch[1]].startswith("touches")


def test_returned_actions_stand_up_to_the_next_call_and_the_end(tmp_path):
    path = write_store(tmp_path / "a.zarr", tasks=(0,))
    episode = open_store(path).episodes[1]
    chunks, num_steps = episode.read("actions"), episode.attributes.num_steps
    assert num_steps < chunks.shape[0] * chunks.shape[1]
    found = curves(as_logged(path, episode.name), "actions")
    for dimension in range(chunks.shape[2]):
        expected = {step: chunks[step // 5, step % 5, dimension] for step in range(num_steps)}
        assert found[str(dimension)] == pytest.approx(expected)


def test_sites_stand_apart(tmp_path):
    path = write_site_store(tmp_path / "a.zarr", kind="alternating", tasks=(0,), episodes=1)
    found = as_logged(path, "task000_episode000")
    for site in ("self", "cross"):
        groups = va.open(path).analyze(by="replan", site=site)["replans_groups"].lazy()
        masses = curves(found, f"{site}/masses")
        for name, values in masses.items():
            own = groups.filter(layer="layers_avg", group=name).sort("replan").select("mass").collect()
            assert list(values.values()) == pytest.approx(own["mass"].to_list())
        assert masses


@pytest.mark.parametrize("kind", ["alternating", "split", "growing"])
def test_every_episode_of_other_policies_is_one_whole_file(tmp_path, rerun, capsys, kind):
    store = write_site_store(tmp_path / "a.zarr", kind=kind)
    assert main(["view", str(store), "--rrd", str(tmp_path / "out")]) == 0
    said, files = capsys.readouterr().out, sorted((tmp_path / "out").iterdir())
    assert said.startswith("About ")
    assert [file.stem for file in files] == [one.name for one in open_store(store).episodes]
    program = Path(sys.executable).with_name("rerun")
    subprocess.run([program, "rrd", "verify", *files], check=True, capture_output=True)
