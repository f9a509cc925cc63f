"""analyze: of which episodes the ratio is, and what it counts twice."""

from __future__ import annotations

import pytest

import vla_attention as va
from tests.kit.archives import example_store

CUBES = example_store("cubes")


@pytest.mark.parametrize("by", [(), ("layer",)])
def test_a_ratio_that_some_episodes_lack_says_first_of_how_many_it_is(by):
    """Only the task of the red cube has the word: the interval is over its episodes, and says nothing of tasks."""
    answer = va.open(CUBES).analyze(groups={"red": "word:red"}, ratio="red/visual", by=by)
    (first, *_) = answer.findings
    assert "2 of 6 episodes (1 of 3 tasks)" in first.sentence
    assert first.limit
    if by:
        assert answer["by"]["episodes_with_ratio"].unique().to_list() == [2]
    else:
        assert (first.numbers["episodes_with_ratio"], first.numbers["tasks_with_ratio"]) == (2, 1)


def test_a_group_alone_in_a_file_is_a_share_of_all_tokens(tmp_path):
    """As on the command line, where the rest is a group of its own."""
    file = tmp_path / "wrist.toml"
    file.write_text('[groups]\nwrist = "camera:left_wrist_0_rgb"\n')
    found = va.open(CUBES).analyze(grouping=str(file))
    given = va.open(CUBES).analyze(groups={"wrist": "camera:left_wrist_0_rgb"})
    assert found.findings[0].numbers == given.findings[0].numbers
    assert found.findings[0].numbers["wrist"] == pytest.approx(0.298, abs=0.01)
    assert sum(found.findings[0].numbers.values()) == pytest.approx(1.0)


def test_a_ratio_that_is_not_shown_says_what_would_have_been(tmp_path):
    """Both halves of the pictures alike: the limit has the detectable ratio, which is beyond the interval."""
    groups = {"even": "patch:base_0_rgb[0:8,0:4]", "odd": "patch:base_0_rgb[0:8,4:8]"}
    found = va.open(CUBES).analyze(groups=groups, ratio="even/odd")
    numbers = found.findings[0].numbers
    assert numbers["ratio_lift_low"] < 1 < numbers["ratio_lift_high"]
    assert "80%" in found.findings[0].limit


def test_groups_that_share_keys_are_named_with_their_number(tmp_path):
    file = tmp_path / "shared.toml"
    file.write_text(
        'name = "shared"\noverlap = true\n[groups]\na = "role:image"\nb = "camera:base_0_rgb"\nt = "word:touch"\n'
        '[ratio]\nnumerator = ["a", "b"]\ndenominator = ["t"]\n'
    )
    (note,) = [note for note in va.open(CUBES).analyze(grouping=str(file)).notes if "twice" in note]
    assert "64" in note
