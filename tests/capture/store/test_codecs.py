"""How many keys a chunk of rows holds: a question about words reads no pictures."""

from __future__ import annotations

from itertools import accumulate, pairwise

import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st

from tests.capture.store.test_disk_estimate import large_tokens
from tests.kit.raw_rows import probabilities
from tests.kit.stores import StoreSpec, expected_arrays, write_store
from vla_attention.capture.store.codecs import FEWEST_KEYS, keys_per_chunk
from vla_attention.schemas.layout import SiteLayout, Span
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


def layout_of(*lengths: int) -> SiteLayout:
    ends = pairwise([0, *accumulate(lengths)])
    return SiteLayout("joint", tuple(Span(f"s{i}", "text", *of) for i, of in enumerate(ends)))


@pytest.mark.parametrize(
    ("lengths", "keys"),
    [
        ((256, 256, 256, 200, 10), 256),  # pi0.5: the prompt and the actions behind it are a chunk
        ((256, 256, 256, 48, 51), 256),  # pi0
        ((512,), 512),  # text that Cosmos reads by cross-attention
        ((196,) * 11, 196),
        ((768, 200), 768),
        ((64, 64, 32, 10), 170),  # no chunk is that small
        ((100, 300, 300), 700),  # none divides both
    ],
)
def test_keys_in_a_chunk(lengths, keys):
    assert keys_per_chunk(layout_of(*lengths)) == keys


@given(lengths=st.lists(st.integers(1, 6).map(lambda n: 64 * n) | st.integers(1, 500), min_size=1, max_size=6))
def test_it_is_the_most_with_which_spans_begin_with_chunks_or_lie_in_the_last(lengths):
    layout, total = layout_of(*lengths), sum(lengths)
    starts = [span.start for span in layout.spans]

    def fits(keys: int) -> bool:
        last = (total - 1) // keys * keys
        return all(start in range(0, total, keys) or start > last for start in starts) and max(starts) >= keys

    assert keys_per_chunk(layout) == max(filter(fits, range(FEWEST_KEYS, total)), default=total)


@pytest.mark.parametrize("bits", [4, 10, 23])
def test_rows_in_several_chunks_of_keys_are_those_that_were_given(tmp_path, bits):
    spec = StoreSpec(tokens=large_tokens(9), mantissa_bits=bits, tasks=(0,), episodes=1)
    path = write_store(tmp_path / "a.zarr", spec=spec)
    store, expected = open_store(path), expected_arrays(spec, 0, 0)["joint/rows"]
    assert verify_store(store) == []
    (episode,) = store.episodes
    assert episode.array("joint/rows").metadata.grid[-1] == 3
    array = zarr.open_array(path / "episodes" / episode.name / "joint/rows", mode="r")
    for found in (episode.read("joint/rows"), probabilities(array)):
        assert (found == expected).all()
    text = episode.array("joint/rows").metadata.whole_chunks(700, 710)
    (read,) = episode.read_layers("joint/rows", [(1, 0)], text)
    assert (text.start, text.stop) == (680, 800)
    assert (read == expected[:, 1, 0, ..., 680:]).all()
