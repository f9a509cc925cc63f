from __future__ import annotations

from vla_attention.analyze.show.headings import (
    WIDTH,
    heading,
    interval_note,
    note_lines,
    run_header,
    title,
    untrained_warning,
    wrap,
)

PLAIN = {"stores": ["runs/a.zarr"], "site": "joint", "layer": "layer 3", "num_episodes": 1, "num_tasks": 1}


def test_lines_are_wrapped_between_words_only():
    lines = wrap("a well-known word " * 20, rest="  ")
    assert max(map(len, lines)) <= WIDTH
    assert all(line.startswith("  ") for line in lines[1:])
    assert "well-" not in [line.split()[-1] for line in lines]
    assert wrap("x" * 150) == ["x" * 150]
    assert wrap("") == []


def test_titles_and_headings_have_rules_of_the_page_s_width():
    assert title("WORDS") == ["WORDS", "=" * WIDTH]
    assert heading("LAYERS") == "LAYERS\n" + "-" * WIDTH


def test_the_header_names_stores_site_layer_and_counts():
    lines = run_header("WORDS", **PLAIN, untrained=False, notes=["one episode is left out"])
    assert lines[:2] == title("WORDS")
    assert lines[2:] == [
        "Stores: runs/a.zarr",
        "Site 'joint', layer 3; 1 episode of 1 task",
        "one episode is left out",
    ]


def test_the_warning_of_untrained_weights_comes_before_every_number():
    lines = run_header("WORDS", **PLAIN, untrained=True)
    assert lines[2].startswith("WARNING: the policy has untrained (random) weights.")
    assert " ".join(lines[2:4]) == untrained_warning()


def test_notes_and_the_level_of_intervals():
    assert note_lines(["first", "second"]) == ["note: first", "note: second"]
    assert interval_note(0.95, "tasks like these").startswith("Intervals: 95%, about tasks like these")
    assert interval_note(0.9, "these tasks", "pointwise").startswith("Intervals: 90%, pointwise, about these tasks")
