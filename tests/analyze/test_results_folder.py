"""Where results land: no two stores share a folder, and none is outside of `results`."""

from __future__ import annotations

import os
from argparse import Namespace
from pathlib import Path

from hypothesis import example, given
from hypothesis import strategies as st

from vla_attention.analyze.options import results_folder
from vla_attention.schemas.stores.store_url import StorePlace, StoreUrl

PARTS = st.sampled_from(["..", ".", "a", "b", "a.zarr", "step_1.0", "step_1.5", "step_1.0.zarr", ".zarr", "results"])
PATHS = st.builds(
    lambda above, parts: Path(above, *parts), st.sampled_from(["", "/", os.getcwd()]), st.lists(PARTS, max_size=4)
)
URLS = st.builds(
    lambda scheme, parts: StoreUrl("/".join([f"{scheme}://host", *parts])),
    st.sampled_from(["hf", "https", "s3"]),
    st.lists(PARTS, max_size=3),
)
PLACES = st.lists(PATHS | URLS, min_size=1, max_size=2)


def identity(place: StorePlace) -> str:
    return os.path.realpath(place) if isinstance(place, Path) else str(place)


@given(PLACES, PLACES)
@example([Path("step_1.0")], [Path("step_1.5")])
@example([Path("../a.zarr")], [Path("a.zarr")])
@example([Path("a")], [Path("a.zarr")])
@example([StoreUrl("https://host/a.zarr")], [StoreUrl("s3://host/a.zarr")])
@example([Path("a.zarr"), Path("x/b.zarr")], [Path("a.zarr"), Path("y/b.zarr")])
def test_every_store_has_a_folder_of_its_own_below_results(one, other):
    folders = [results_folder(stores, "words", Namespace()) for stores in (one, other)]
    same = [identity(place) for place in one] == [identity(place) for place in other]
    assert (folders[0] == folders[1]) == same
    for folder in folders:
        assert ".." not in folder.parts
        assert folder.parts[0] == "results"
        assert Path(os.path.abspath(folder)).is_relative_to(Path.cwd() / "results")
