"""Every example of docs/groupings.md is read, resolved and run."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest

from tests.kit.bowl_scene import bowl_tokens, write_bowl_store
from vla_attention.analyze.__main__ import main
from vla_attention.schemas.groupings.grouping import Grouping, read_grouping_file
from vla_attention.schemas.groupings.resolve import check_names, resolve
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, collect_vocabulary
from vla_attention.schemas.layout import Role, SiteLayout, Span

GUIDE = (Path(__file__).parents[3] / "docs" / "groupings.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", GUIDE, re.DOTALL | re.MULTILINE)


def first_column(heading: str) -> list[str]:
    """The code in the first column of the table with that heading."""
    table = GUIDE.split(f"| {heading} |")[1].split("\n\n")[0]
    return [cell.replace("\\|", "|") for cell in re.findall(r"^\| `(.*?)` \|", table, re.MULTILINE)]


def latent_tokens() -> EpisodeTokens:
    names = ("blank", "proprio", "wrist", "primary", "action")
    spans = [
        Span(name, "latent", i, i + 1, camera=name if name in ("wrist", "primary") else None)
        for i, name in enumerate(names)
    ]
    roles = np.array([[Role.BLANK, Role.PROPRIO, Role.IMAGE, Role.IMAGE, Role.ACTION]], dtype=np.uint8)
    return EpisodeTokens(SiteLayout("self", tuple(spans)), roles)


@pytest.mark.parametrize("text", blocks("toml"))
def test_every_file_takes_keys_with_every_group(text, tmp_path):
    assert tomllib.loads(text)["groups"]
    (tmp_path / "example.toml").write_text(text)
    grouping, tokens = read_grouping_file(tmp_path / "example.toml"), bowl_tokens()
    check_names(grouping, collect_vocabulary([tokens]), tokens.layout)
    resolved = resolve(grouping, tokens)
    assert (resolved.num_keys > 0).all(axis=0).all()


@pytest.mark.parametrize("selector", first_column("selector | takes"))
def test_every_selector_takes_keys(selector):
    tokens = bowl_tokens()
    grouping = Grouping("g", {"g": (selector,)})
    check_names(grouping, collect_vocabulary([tokens]), tokens.layout)
    assert resolve(grouping, tokens).num_keys.min() > 0


@pytest.mark.parametrize("selector", first_column("selector, Cosmos | takes"))
def test_every_latent_frame_takes_its_key(selector):
    resolved = resolve(Grouping("g", {"g": (selector,)}), latent_tokens())
    assert np.flatnonzero(resolved.weights[0, :, 0]).tolist() == [3]


@pytest.mark.drawn
def test_every_command_runs(tmp_path, monkeypatch, capsys):
    write_bowl_store(tmp_path / "runs" / "libero_10.zarr", tasks=(0,), episodes=1, layers=(0,), denoise_steps=(0,))
    monkeypatch.chdir(tmp_path)
    commands = [line for block in blocks("bash") for line in block.splitlines() if line.startswith("vla-attention")]
    assert len(commands) >= 5
    for command in commands:
        words = shlex.split(command)[1:]
        drawn = ["--no-plots"] if "--task" not in words else []
        assert main([*words, *drawn, "--output", str(tmp_path / "out")]) == 0, capsys.readouterr().err
    assert (tmp_path / "out" / "group_patches.png").stat().st_size > 10_000
