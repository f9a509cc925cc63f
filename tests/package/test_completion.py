"""The completion script, as bash runs it."""

from __future__ import annotations

import shlex
import subprocess

import pytest

from vla_attention.analyze.commands import COMMANDS
from vla_attention.completion import commands_of_all_programs, completion_script, main


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("completion") / "completion.sh"
    path.write_text(completion_script())
    return path


def completed(script, *words: str) -> list[str]:
    """What bash offers for the last word."""
    code = (
        f". {shlex.quote(str(script))}; COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}; "
        'COMPREPLY=(); _vla_attention_complete; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def test_commands(script):
    assert completed(script, "vla-analyze", "") == list(COMMANDS)
    assert completed(script, "vla-analyze", "wor") == ["words"]
    assert completed(script, "vla-attention", "comp") == ["completion", "compare"]
    assert completed(script, "vla-attention", "analyze", "rep") == ["report"]
    assert completed(script, "vla-capture", "re") == ["replay", "rerun"]
    assert completed(script, "/somewhere/bin/vla-attention", "completion", "") == ["bash", "zsh"]


def test_options_are_those_of_the_command(script):
    assert completed(script, "vla-analyze", "time", "runs/a.zarr", "--bi") == ["--bins"]
    assert completed(script, "vla-analyze", "words", "runs/a.zarr", "--bi") == []
    assert completed(script, "vla-attention", "capture", "pi", "--num-e") == ["--num-episodes", "--num-envs"]


def test_a_store_without_a_command_has_the_options_of_ratios(script):
    assert completed(script, "vla-analyze", "runs/a.zarr", "--without-s") == ["--without-sinks"]


def test_values(script):
    for intervals in (["vla-analyze"], ["vla-analyze", "words"], ["vla-attention", "analyze", "words"]):
        assert completed(script, *intervals, "a.zarr", "--intervals", "th") == ["these-tasks"]
    assert completed(script, "vla-capture", "pi", "--protocol", "") == ["openpi", "lerobot"]


def test_paths_are_left_to_the_shell(script):
    assert completed(script, "vla-analyze", "runs/") == []
    assert completed(script, "vla-analyze", "words", "") == []
    assert completed(script, "vla-capture", "pi", "--output", "") == []


def test_every_command_is_there():
    known = {command.words for command in commands_of_all_programs()}
    assert {f"vla-analyze {name}" for name in COMMANDS} <= known
    assert {f"vla-attention analyze {name}" for name in COMMANDS} <= known
    assert {"vla-capture pi", "vla-capture cosmos", "vla-capture doctor", "vla-capture rerun"} <= known


def test_both_shells_get_the_same_script(capsys):
    printed = []
    for shell in ("bash", "zsh"):
        assert main([shell]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] == completion_script()
