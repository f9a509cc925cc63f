"""Every command says of the run that it answers from what was changed in it, and that its prompts were cut."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import pytest
from msgspec import structs

from tests.kit.planted_effects import planted_effects
from tests.kit.stores import StoreSpec, small_steps, write_store
from tests.kit.thorough import thorough_except
from tests.kit.tokens import small_tokens
from vla_attention.analyze.__main__ import main
from vla_attention.schemas.interventions import Interventions, KeyKnockout, PromptChange

SPEC = StoreSpec(tasks=(0,), episodes=3, plant_effects=planted_effects())


def fallen(*which):
    """`PlantSteps` of a scene in which a bowl is not on its ramekin."""
    steps = small_steps(*which)
    return replace(steps, attributes=structs.replace(steps.attributes, mujoco="3.8.1", lost_relations=("a on b",)))


#: A store's spec, and what must be named of it.
KINDS = {
    "cut": (SPEC, "('and then the drawer')"),
    "told": (replace(SPEC, plant_effects=None), "instruction in 3 episodes"),
    "replaced": (replace(SPEC, interventions=Interventions("shuffled", prompt=PromptChange("shuffled"))), "shuffled"),
    "knocked out": (
        replace(SPEC, interventions=Interventions("blind", keys=(KeyKnockout("role:image"),))),
        "role:image",
    ),
    "elsewhere": (
        replace(SPEC, suite="libero_spatial", plant_steps=fallen),
        "in 3 of 3 episodes the scene did not begin",
    ),
    "neither": (SPEC, ""),
}
COMMANDS = {
    "analyze": (),
    "language": (),
    "failures": (),
    "words": (),
    "objects": (),
    "effects": (),
    "by": ("--by", "time"),
    "overlay": ("--task", "0", "--episode", "0"),
    "report": (),
    "list": ("--list",),
    "view": ("--no-open",),
    "compare": ("--allow-mismatch", "suite"),
}


def cut(tokens):
    """The tokens with prompts that go on behind their last piece."""
    prompts = [structs.replace(prompt, text=f"{prompt.text} and then the drawer") for prompt in tokens.prompts]
    return replace(tokens, prompts=tuple(prompts))


def told(tokens):
    """The tokens with prompts whose instruction is spelt backwards."""
    made = []
    for prompt in tokens.prompts:
        first, last = prompt.instruction
        made.append(
            structs.replace(prompt, text=prompt.text[:first] + prompt.text[first:last][::-1] + prompt.text[last:])
        )
    return replace(tokens, prompts=tuple(made))


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    made = {"other": write_store(folder / "other.zarr", spec=SPEC)}
    for name, (spec, _) in KINDS.items():
        tokens = {"cut": cut, "told": told}.get(name, lambda _: None)(small_tokens(3, 0, 0))
        made[name] = write_store(folder / f"{name}.zarr", spec=replace(spec, tokens=tokens))
    return made


@pytest.mark.parametrize(
    ("kind", "command"),
    thorough_except(
        [
            ("cut", "words"),
            ("cut", "view"),
            ("told", "compare"),
            ("replaced", "list"),
            ("elsewhere", "language"),
            ("neither", "list"),
        ],
        [
            *(("cut", command) for command in COMMANDS),
            *(("told", command) for command in ("language", "list", "view", "compare")),
            *(("replaced", command) for command in ("analyze", "list", "effects", "compare")),
            *(("knocked out", command) for command in ("analyze", "words", "by", "report")),
            *(("elsewhere", command) for command in COMMANDS),
            *(("neither", command) for command in ("analyze", "list")),
        ],
        several=True,
    ),
)
def test_every_command_says_it(stores, tmp_path, monkeypatch, capsys, kind, command):
    monkeypatch.setattr("vla_attention.analyze.view.server.ViewerServer.serve_forever", lambda self: None)
    words = ["analyze" if command in ("list", "by") else command]
    words += [str(stores[kind])] + [str(stores["other"])] * (command == "compare") + list(COMMANDS[command])
    if command != "view":
        output = tmp_path / ("a.html" if command == "report" else "results")
        words += ["--output", str(output)]
    assert main(words) == 0
    printed = capsys.readouterr()
    said = printed.out + printed.err + ((tmp_path / "a.html").read_text() if command == "report" else "")
    said = " ".join(said.replace("&#39;", "'").split())
    expected = KINDS[kind][1]
    assert (
        (expected in said)
        if expected
        else all(other not in said for other in ("and then the drawer", "instruction in 3 episodes", "did not begin"))
    )


def test_the_page_opens_beside_a_damaged_episode(stores, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("vla_attention.analyze.view.server.ViewerServer.serve_forever", lambda self: None)
    damaged = shutil.copytree(stores["cut"], tmp_path / "cut.zarr")
    (damaged / "episodes/task000_episode001/seal/zarr.json").write_text("no document")
    assert main(["view", str(damaged), "--no-open"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "http" in said
    assert re.search(r"in 2 episodes .*\('and then the drawer'\)", said)
