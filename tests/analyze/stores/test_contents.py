from __future__ import annotations

from vla_attention.analyze.stores.contents import describe_store
from vla_attention.schemas.stores.reader import StoredEpisode, open_store
from vla_attention.testing.stores import write_store


def test_listing_reads_arrays_of_one_episode_only(tmp_path, monkeypatch):
    """A store of thousands of episodes is listed in seconds: what differs between episodes is in their attributes."""
    store = open_store(write_store(tmp_path / "a.zarr", tasks=(0, 1), episodes=3))
    whole = describe_store(store)
    read = StoredEpisode.read
    names = set()
    monkeypatch.setattr(StoredEpisode, "read", lambda self, *given: names.add(self.name) or read(self, *given))
    again = describe_store(open_store(store.path))
    assert names == {"task000_episode000"}
    assert again == whole
    vocabulary = {word for episode in store.episodes for word in episode.attributes.instruction.split()}
    listed = next(line for line in whole.splitlines() if line.startswith("  words"))
    assert vocabulary <= set(listed.replace(",", "").split())
