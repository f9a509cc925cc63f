"""A capture with --resume names what lies among the episodes and is none, and goes on."""

from __future__ import annotations

from tests.kit.simulators_in_threads import record
from vla_attention.schemas.stores.root import list_episodes


def test_a_stray_folder_does_not_stop_a_resumed_capture(scene, tmp_path, capsys):
    store = tmp_path / "a.zarr"
    assert record(store, 1, "--task-id", "0", "--num-episodes", "1") == 0
    (store / "episodes/old").mkdir()
    (store / "episodes/.DS_Store").write_text("")
    capsys.readouterr()
    assert record(store, 1, "--task-id", "0", "--num-episodes", "2", "--resume") == 0
    said = capsys.readouterr()
    assert "1 episode added" in said.out
    assert said.err == (
        f"vla-capture: Ignored in {store}, among its episodes: .DS_Store, old; they are no episodes. Move them out of "
        "the store.\n"
    )
    folders, strays = list_episodes(store)
    assert len(folders) == 2
    assert strays == [".DS_Store", "old"]
