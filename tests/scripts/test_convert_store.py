"""Stores of before rows were float16: refused with a sentence, and brought up to date by a script."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import zarr

import vla_attention as va
from scripts.convert_store import convert
from tests.kit.golden_stores import golden_store
from tests.kit.raw_rows import probabilities
from tests.kit.stores import write_array
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.digest import ArrayDigest
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import SEAL_FILE, read_seal, seal_document, seal_episode
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.schemas.stores.verify import verify_store


@pytest.fixture
def older(tmp_path):
    """Rows in float32, sums and what uniform attention gives beside them, and seals without checksums of chunks."""
    store = tmp_path / "older.zarr"
    shutil.copytree(golden_store("cosmos"), store)
    for episode in open_store(store).episodes:
        folder = store / "episodes" / episode.name
        document = json.loads((folder / "zarr.json").read_text())
        for site in ("self", "cross"):
            rows = probabilities(zarr.open_array(folder / site / "rows", mode="r"))
            atoms = episode.read(f"{site}/atoms")
            before = {
                "rows": rows,
                "uniform": episode.uniform(site),
                "atoms": atoms[..., :-1],
                "row_sum": atoms[..., -1],
            }
            for name, values in ((f"{site}/{kind}", values) for kind, values in before.items()):
                shutil.rmtree(folder / name, ignore_errors=True)
                rest = [1, 1, *values.shape[3:]] if values.ndim == 6 else values.shape[1:]
                whole = (-(-len(values) // 8) * 8, *values.shape[1:])
                layout = {"chunks": (8, *rest), "shards": whole} if values.ndim == 6 else {"chunks": values.shape}
                write_array(folder / name, np.ascontiguousarray(values), **layout)
                digest = ArrayDigest()
                digest.update(values)
                document["attributes"]["arrays"][name] = {"shape": values.shape, "sha256": digest.hexdigest()}
        (folder / "zarr.json").write_text(json.dumps(document))
        seal = to_json(seal_episode(folder, folder.name, read_seal(folder).run))
        for record in seal["files"].values():
            record.pop("chunks", None)
        (folder / SEAL_FILE).write_bytes(seal_document(seal))
    return store


def test_the_script_makes_the_store_of_today(older):
    with pytest.raises(CorruptEpisode, match=r"float32.*expected float16.*convert_store\.py"):
        va.open(older).analyze()
    assert any("convert_store.py" in fault.problem for fault in verify_store(open_store(older)))
    assert convert(older) == 2
    assert verify_store(open_store(older)) == []
    for mine, theirs in zip(open_store(older).episodes, open_store(golden_store("cosmos")).episodes, strict=True):
        assert mine.attributes == theirs.attributes
        assert mine.files.records.keys() == theirs.files.records.keys()
        for site in ("self", "cross"):
            np.testing.assert_array_equal(mine.read(f"{site}/rows"), theirs.read(f"{site}/rows"))
    assert convert(older) == 0
