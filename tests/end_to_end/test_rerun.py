"""Reruns of stores that were captured in a simulator: to the bit, and with interventions on words and objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.kit.thorough import thorough_except
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

pytestmark = [pytest.mark.simulator, pytest.mark.libero]

#: Family -> the options of a short capture, and the camera that shows the objects.
FAMILIES = {
    "pi": (("--checkpoint", "untrained-tiny", "--max-steps", "12"), "base_0_rgb"),
    "cosmos": (("--ckpt-path", "untrained-tiny", "--max-steps", "20"), "primary"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("family", thorough_except(["pi"], FAMILIES))
def test_a_libero_store_is_made_again_and_without_an_object_and_a_word(
    family: str, libero_assets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options, camera = FAMILIES[family]
    base = tmp_path / "base.zarr"
    words = ["--task-suite", "libero_10", "--task-id", "0", "--num-episodes", "1"]
    assert capture([family, *options, *words, "--libero-assets", str(libero_assets), "--output", str(base)]) == 0
    again, changed = tmp_path / "again.zarr", tmp_path / "changed.zarr"
    assert capture(["rerun", str(base), "--output", str(again)]) == 0
    assert ": bit-equal" in capsys.readouterr().out
    [stored], [repeated] = open_store(base).episodes, open_store(again).episodes
    assert stored.attributes.arrays == repeated.attributes.arrays

    soup = "object:alphabet_soup_1"
    knockouts = ["--knockout", soup, "--knockout", "word:soup", "--image", f"{camera}=filled:tomato_sauce_1"]
    assert capture(["rerun", str(base), "--output", str(changed), *knockouts, "--check", "1"]) == 0
    store = open_store(changed)
    assert verify_store(store) == []
    [episode] = store.episodes
    assert (episode.read("actions") != stored.read("actions")).any()
    for site in store.attributes.sites:
        tokens = episode.tokens(store.attributes, site.name)
        rows = episode.read(f"{site.name}/rows")
        if camera in site.cameras:
            (span,) = site.camera_spans(camera)
            names = [thing.name for thing in tokens.objects]
            covered = np.asarray(tokens.coverage[camera])[..., names.index("alphabet_soup_1")]
            assert (covered > 0).any()
            whole = np.argwhere(covered == 1)
            assert all((rows[replan, ..., span.start + patch] == 0).all() for replan, patch in whole)
        keys = [key for word in (tokens.words[0] if tokens.words else ()) if word.text == "soup" for key in word.keys]
        assert (rows[..., keys] == 0).all()
    sauce = [thing.name for thing in episode.attributes.objects].index("tomato_sauce_1")
    patches = episode.read(f"objects/{camera}")[..., sauce] > 0
    assert patches.any()
    assert (episode.read(f"frames/{camera}") != stored.read(f"frames/{camera}")).any()
