"""What the writer refuses at `append`, `verify` reports where the writer let it through: one rule, two callers."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from tests.kit.stores import StoreSpec, commit, denoise_times, episode_records, root_attributes
from tests.kit.thorough import thorough_except
from vla_attention.capture.store.episode_writer import EpisodeWriter, ReplanRefused
from vla_attention.capture.store.replan_records import ReplanRecord
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

#: Recorded layers 4 and 7, denoise steps 3 and 9, heads 1 and 5: no number is its own position.
SPEC = StoreSpec(layers=(4, 7), num_layers=9, denoise_steps=(3, 9), heads=(1, 5), contributions=True, replans=3)
Change = Callable[[ReplanRecord], ReplanRecord]


def rows_with(**changes: Callable[[np.ndarray], Any]) -> Change:
    """Change arrays of the recorded rows of `joint`; a function changes a copy, or returns another array."""

    def change(record: ReplanRecord) -> ReplanRecord:
        joint = record.rows["joint"]
        changed = {}
        for name, edit in changes.items():
            values = getattr(joint, name).copy()
            result = edit(values)
            changed[name] = values if result is None else result
        return replace(record, rows={"joint": replace(joint, **changed)})

    return change


def put(index: Any, value: float) -> Callable[[np.ndarray], None]:
    def edit(values: np.ndarray) -> None:
        values[index] = value

    return edit


def roles_with(key: int, code: int) -> Change:
    def change(record: ReplanRecord) -> ReplanRecord:
        roles = record.key_role["joint"].copy()
        roles[key] = code
        return replace(record, key_role={"joint": roles})

    return change


def coverage_with(edit: Callable[[np.ndarray], Any], camera: str = "base_0_rgb") -> Change:
    def change(record: ReplanRecord) -> ReplanRecord:
        values = record.coverage[camera].copy()
        result = edit(values)
        return replace(record, coverage={**record.coverage, camera: values if result is None else result})

    return change


def with_(**changes: Any) -> Change:
    return lambda record: replace(record, **changes)


def doubled(record: ReplanRecord) -> ReplanRecord:
    """Rows that sum to 2, and say so."""
    joint = record.rows["joint"]
    rows, sums = joint.rows.copy(), joint.row_sum.copy()
    rows[0, 1, 1] *= 2
    sums[0, 1, 1] *= 2
    return replace(record, rows={"joint": replace(joint, rows=rows, row_sum=sums)})


def without_contribution(record: ReplanRecord) -> ReplanRecord:
    return replace(record, rows={"joint": replace(record.rows["joint"], contribution=None)})


def mass_to_padding(rows: np.ndarray) -> None:
    rows[1, 0, 1, 0, [0, 29]] = rows[1, 0, 1, 0, [29, 0]]


def instruction_beyond_the_text(record: ReplanRecord) -> ReplanRecord:
    return replace(record, prompt=structs.replace(record.prompt, instruction=(0, 999)))


#: Name, change, what the error names (a regular expression). They can be stored: `verify` must find them, too.
STORABLE: dict[str, tuple[Change, str]] = {
    "infinite row": (
        rows_with(rows=put((1, 0, 1, 0, 7), np.inf)),
        "joint/rows .*infinite.* replan 1, denoise step 3, layer 7, head 5",
    ),
    "wrong row sum": (
        rows_with(row_sum=put((1, 1, 1, 0), 1.0008)),
        r"joint/rows .*sums.* 0\.0008 .*1e-05, at replan 1, denoise step 9, layer 7, head 5",
    ),
    "rows that sum to 2": (
        doubled,
        r"joint/(row_sum|atoms) is 2 .*1 .*0\.001\) at replan 1, denoise step 9, layer 4, head 5",
    ),
    "mass for padding": (
        rows_with(rows=mass_to_padding),
        "joint/rows .*joint/uniform.* replan 1, denoise step 3, layer 7, head 5",
    ),
    "asymmetric contributions": (
        rows_with(contribution=put((1, 0, 0, 1), 1e6)),
        "joint/contribution .*symmetric.* replan 1, denoise step 3, layer 7",
    ),
    "no inner products": (
        rows_with(contribution=lambda gram: gram[0, 1].fill(0) or put((0, 1, [0, 1], [1, 0]), 1.0)(gram)),
        "joint/contribution .*eigenvalues.* replan 1, denoise step 9, layer 4",
    ),
    "a word that is padding": (roles_with(21, Role.PADDING), "'put'"),
    "coverage of another camera": (
        coverage_with(lambda shares: shares[:4]),
        r"12, 5\): .*3 x 4 patches",
    ),
    "more than a patch": (
        coverage_with(put((5, 2), 1.5)),
        r"objects/base_0_rgb .*1\.5; .*0 to 1, at replan 1, patch 5, object 2",
    ),
    "an unknown camera": (
        lambda record: replace(
            record,
            frames={**record.frames, "left": record.frames["base_0_rgb"]},
            coverage={**record.coverage, "left": record.coverage["base_0_rgb"]},
        ),
        "frames/left .*base_0_rgb, left_wrist_0_rgb, right_wrist_0_rgb",
    ),
    "an instruction beyond the text": (instruction_beyond_the_text, "0 to 999"),
}

#: What the store has no place for, or reads as a lost chunk.
UNSTORABLE: dict[str, tuple[Change, str]] = {
    "NaN in two rows": (
        rows_with(rows=put((slice(None), 1, 1, 0, 7), np.nan)),
        "joint/rows .*NaN.* replan 1, denoise step 9, layer 4, head 5, .* 2 of 8 ",
    ),
    "NaN row sum": (
        rows_with(row_sum=put((1, 0, 0, 0), np.nan)),
        r"joint/row_sum is nan .*1 .*0\.001\) at replan 1, denoise step 3, layer 7",
    ),
    "rows of too few heads": (
        rows_with(rows=lambda rows: rows[:, :, :1]),
        r"joint/rows .*\(1, 2, 2, 1, 1, 39\); .*\(1, 2, 2, 2, 1, 39\)",
    ),
    "no contributions": (without_contribution, "joint/contribution"),
    "no role": (
        roles_with(3, 99),
        "joint/key_role .*'base_0_rgb' .*99.* image",
    ),
    "no site": (with_(rows={}), "none.* joint"),
    "NaN state": (with_(state=np.array([np.nan] * 8)), "state .*NaN"),
    "no pictures": (with_(frames={}), "frames/base_0_rgb"),
    "negative seed": (with_(noise_seed=-1), "noise_seed is -1"),
}


def test_replans_that_cannot_be_right_are_refused_and_leave_nothing(tmp_path):
    """Each is offered as the second replan of one episode, which is then completed and whole."""
    store = open_run(tmp_path / "a.zarr", root_attributes(SPEC), "new", durable=False)
    start, records = episode_records(SPEC, 0, 0)
    with store.episode(start, denoise_times(SPEC)) as writer:
        writer.append(records[0])
        for name, (change, named) in (STORABLE | UNSTORABLE).items():
            with pytest.raises(ReplanRefused) as caught:
                writer.append(change(records[1]))
            text = str(caught.value)
            assert re.search(rf"replan 1 \(environment step 1.*task000_episode000 of {store.path}: ", text), name
            assert re.search(named, text), (name, text)
            assert isinstance(caught.value, UserError)
        for record in records[1:]:
            writer.append(record)
        commit(writer, SPEC, 0, 0)
    assert verify_store(open_store(store.path)) == []


@pytest.mark.parametrize(
    "name",
    thorough_except(("infinite row", "wrong row sum", "mass for padding", "coverage of another camera"), STORABLE),
)
@pytest.mark.filterwarnings("ignore:invalid value encountered in matmul")
def test_verify_reports_what_the_writer_refuses(tmp_path, monkeypatch, name):
    """Written by a writer without rules: checksums, digests and seal are in order."""
    monkeypatch.setattr(EpisodeWriter, "_problems", lambda writer, record: iter(()))
    monkeypatch.setattr(EpisodeWriter, "_read_back", lambda writer, run: None)
    change, named = STORABLE[name]
    # A changed role makes another number of parts, which the contributions would contradict, too.
    spec = replace(SPEC, mantissa_bits=23, contributions=" role" not in name)
    store = open_run(tmp_path / "a.zarr", root_attributes(spec), "new", durable=False)
    start, records = episode_records(spec, 0, 0)
    alike = name in ("an unknown camera",) or name.startswith(("a picture", "coverage of"))  # to be stacked
    records = [change(record) if alike or i == 1 else record for i, record in enumerate(records)]
    with store.episode(start, denoise_times(spec)) as writer:
        for record in records:
            writer.append(record)
        commit(writer, spec, 0, 0)
    problems = [fault.problem for fault in verify_store(open_store(store.path))]
    assert any(re.search(named, problem) for problem in problems), problems


def test_an_object_out_of_view_and_rounded_rows_are_no_fault(tmp_path):
    spec = replace(SPEC, mantissa_bits=1, queries="all")
    start, records = episode_records(spec, 0, 0)
    unseen = np.zeros_like(records[0].coverage["base_0_rgb"])
    unseen[:, -1] = 1
    store = open_run(tmp_path / "a.zarr", root_attributes(spec), "new", durable=False)
    with store.episode(start, denoise_times(spec)) as writer:
        for record in records:
            writer.append(replace(record, coverage={camera: unseen[: len(v)] for camera, v in record.coverage.items()}))
        commit(writer, spec, 0, 0)
    assert verify_store(open_store(store.path)) == []
