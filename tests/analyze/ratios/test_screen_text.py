"""`vla-attention analyze STORE` fits a screen, begins with the answer, and leaves the rest to summary.txt."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.analyze.__main__ import main
from vla_attention.analyze.ratios.answer import conclusion, headline_of, ratio_sentence
from vla_attention.analyze.show.answer import SCREEN_LINES
from vla_attention.testing.stores import StoreSpec, write_store

SMALL = StoreSpec(replans=1, heads=(0,), frames=False, contributions=True)
SHAPES = {
    "one episode": {"tasks": (0,), "episodes": 1},
    "ten tasks": {"tasks": tuple(range(10)), "layers": tuple(range(18)), "num_layers": 18},
    "sixty tasks": {"tasks": tuple(range(60)), "episodes": 1, "layers": (0,)},
    "forty layers": {"layers": tuple(range(40)), "num_layers": 40},
    "without contributions": {"contributions": False, "tasks": tuple(range(12))},
}
LONG = ("a" * 70, "b" * 70)
#: Groupings: with the default ratio, without a ratio, of many groups.
QUESTIONS = {
    "default": [],
    "no ratio": ["--group", "bowl=role:instruction", "--group", "rest=*"],
    "many": ["--grouping", "objects"],
    "long": ["--group", f"{LONG[0]}=role:image", "--group", f"{LONG[1]}=*", "--ratio", "/".join(LONG)],
}


@pytest.fixture(scope="module")
def store(request, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("screen")
    changes = SHAPES[request.param]
    return write_store(folder / "a_store_of_a_run_with_a_long_name.zarr", spec=SMALL, **changes)


def printed(capsys, *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == 0
    out: str = capsys.readouterr().out
    return out


@pytest.mark.parametrize(
    ("store", "question"),
    [
        *((shape, "default") for shape in SHAPES),
        ("ten tasks", "no ratio"),
        ("ten tasks", "many"),
        ("ten tasks", "long"),
    ],
    indirect=["store"],
)
def test_it_fits_a_screen_and_says_where_the_rest_is(store, question, tmp_path, capsys):
    folder = tmp_path / "results"
    out = printed(capsys, store, "--output", folder, "--no-plots", *QUESTIONS[question])
    lines = out.splitlines()
    assert len(lines) <= SCREEN_LINES == 40, out
    assert max(len(line) for line in lines if str(tmp_path) not in line) <= 100
    assert out.count("CONTRIBUTIONS") <= 1
    assert f"{folder / 'summary.txt'}" in "\n".join(lines[-8:])
    for raw in ("None", "nan", "null"):
        assert raw not in out.split()
    whole = (folder / "summary.txt").read_text()
    assert whole.count("CONTRIBUTIONS") == ("contributions" in str(sorted(folder.iterdir())))
    num_tasks = len({episode.name[:7] for episode in (store / "episodes").glob("task*")})
    tasks = lines[next(i for i, line in enumerate(lines) if line.startswith("TASKS")) + 1 :]
    shown = tasks[: tasks.index("")]
    if shown[-1].endswith("more tasks in summary.txt"):
        left = int(shown.pop().split()[0])
        assert left + len(shown) == num_tasks
        assert len(shown) >= 3
    else:
        assert len(shown) == num_tasks


def test_pictures_and_their_files_fit_too(tmp_path, capsys):
    store = write_store(tmp_path / "a.zarr", spec=SMALL, tasks=(0, 1), layers=(0,))
    out = printed(capsys, store, "--output", tmp_path / "out", "--save-viz")
    assert len(out.splitlines()) <= SCREEN_LINES, out
    assert (tmp_path / "out" / "ratio_distribution.png").exists()


def test_the_answer_stands_first_here_and_in_the_summary(tmp_path, capsys):
    store = write_store(tmp_path / "a.zarr", spec=SMALL, tasks=(0, 1), episodes=3)
    out = " ".join(printed(capsys, store, "--output", tmp_path / "out", "--no-plots").split())
    assert out.startswith("made-up, untrained (")
    assert "6 episodes of 2 tasks, 2 solved" in out
    for sentence in ("The ratio visual / linguistic is", "uniform attention gives", "nothing may be concluded"):
        assert sentence in out
        assert sentence in " ".join((tmp_path / "out" / "summary.txt").read_text().split())
    assert out.index("nothing may be concluded") < out.index("LAYERS")


#: A cell of the tables over all tasks: attention on what is seen is below that of uniform attention.
CELL = {
    "geometric_mean": 3.0,
    "geometric_mean_low": 2.0,
    "geometric_mean_high": 4.0,
    "uniform_ratio": 5.0,
    "ratio_lift": 0.6,
    "ratio_lift_low": 0.4,
    "ratio_lift_high": 0.8,
}


def headline(untrained=False, **changes):
    return headline_of({**CELL, **changes}, "seen / read", "mean", "tasks like these", untrained)


def test_the_ratio_stands_beside_that_of_uniform_attention():
    assert ratio_sentence(headline()) == (
        "The ratio seen / read is 3 (mean; 95% interval [2, 4] about tasks like these); uniform attention gives 5, and "
        "the lift is 0.600 [0.400, 0.800]."
    )


@pytest.mark.parametrize(
    ("changes", "tasks", "episodes", "expected"),
    [
        ({}, 5, 10, "Against read, seen gets less than uniform attention gives it"),
        ({"ratio_lift": 2.0, "ratio_lift_high": 3.0, "ratio_lift_low": 1.5}, 5, 10, "Against read, seen gets more"),
        ({"geometric_mean_high": 6.0}, 5, 10, "seen gets less"),  # the lift decides
        ({"ratio_lift_high": 1.2}, 5, 10, "looks as uniform attention does"),
        (
            {"ratio_lift_low": None, "ratio_lift_high": None},
            1,
            1,
            "nobody knows whether it differs from uniform",
        ),
        ({"geometric_mean": None, "ratio_lift": None}, 5, 10, "Nothing may be concluded"),
        ({"uniform_ratio": None, "ratio_lift": None}, 5, 10, "Nothing may be concluded"),
        ({}, 1, 3, "One task shows nothing about other tasks. 3 episodes are few."),
    ],
)
def test_what_may_be_concluded(changes, tasks, episodes, expected):
    assert expected in conclusion(headline(**changes), False, tasks, episodes)
    assert "nothing may be concluded about any policy" in conclusion(headline(True), True, tasks, episodes)
