"""The commands on stores: a line each. Imports nothing heavy, so that `--help` is fast."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        answers: what it answers or does, for the list of commands and its help.
        options: what a question takes besides stores, tasks and output; names of `analyze.options.OPTIONS`.
        site: kinds of spans of which the site that is asked must have one; any site if there are none.
        needs: what is said of a store without such a site.
        examples: command lines behind `vla-attention`, for the help of a question.
        folder: whether it is `analyze.NAME.command`, with a parser of its own, instead of a question.
        keeps: whether it keeps stores instead of asking them; its parser has all of its options.
        page: whether its function gives several results, which are one HTML file.
        runs: whether it takes runs, each of one or several stores, instead of the stores of one.
        data: whether it takes a data set, or one store, instead of stores.
    """

    answers: str
    options: tuple[str, ...] = ()
    site: tuple[str, ...] = ()
    needs: str = ""
    examples: tuple[str, ...] = ()
    folder: bool = False
    keeps: bool = False
    page: bool = False
    runs: bool = False
    data: bool = False


_ROWS = ("layers", "denoise", "heads", "site", "intervals")
_GROUPING = ("grouping", "group", "ratio")
_STRIPS = ("episode", "replans", "cameras", "outline", "smooth", "video", "fps")
_NO_WORDS = "its keys spell no words; choose a site with text by --site (Cosmos: cross)"
_NO_PICTURES = "its keys are no patches of pictures; choose a site with cameras by --site (Cosmos: self)"

#: Name -> command. The function NAME of `analyze.commands.NAME` answers a question.
COMMANDS: dict[str, Command] = {
    "analyze": Command(
        "looks or reads? how attention is divided; --by layer, head, time ...",
        (*_ROWS, *_GROUPING, "by", "without_sinks", "units", "list", "save_viz"),
        examples=(
            "analyze runs/libero_10.zarr",
            "analyze runs/libero_10.zarr --by layer,head",
            "analyze runs/libero_10.zarr --group bowl=object:bowl_1 --group noun=word:bowl --ratio bowl/noun",
            "analyze runs/libero_10.zarr --list",
        ),
    ),
    "data": Command(
        "before training: do the data ask for the sentence, or does the first picture tell it",
        examples=("data ORG/NAME", "data data/so101_pick --num-episodes 500", "data runs/cubes.zarr"),
        data=True,
    ),
    "language": Command(
        "does it listen: what it was told and did, which words decide, and which are read",
        (*_ROWS, "units"),
        ("text",),
        _NO_WORDS,
        ("language runs/cubes.zarr", "language runs/cubes.zarr --task 'touch the red cube' 'touch the blue cube'"),
    ),
    "failures": Command(
        "why did it fail: what was done instead, and where failed episodes left solved ones",
        ("site", "twins"),
        ("text",),
        _NO_WORDS,
        ("failures runs/cubes.zarr", "failures runs/a.zarr --twins runs/b.zarr"),
    ),
    "words": Command(
        "which words of the instruction are read",
        (*_ROWS, "by"),
        ("text",),
        _NO_WORDS,
        ("words runs/libero_10.zarr", "words runs/libero_10.zarr --task 3", "words runs/cosmos.zarr --by layer"),
    ),
    "objects": Command(
        "does it look for what is named? objects over their area and what their place explains; pointing game and IoU",
        (*_ROWS, "by", "iou"),
        ("image", "latent"),
        _NO_PICTURES,
        ("objects runs/libero_10.zarr", "objects runs/libero_10.zarr --by layer", "objects runs/cubes.zarr --no-iou"),
    ),
    "effects": Command(
        "what the action depends on: without a word, a picture, an object; or a data set's actions",
        (*_ROWS, "by", "units"),
        examples=("effects runs/cubes.zarr", "effects runs/cubes.zarr --by task", "effects runs/droid.zarr"),
    ),
    "compare": Command(
        "what changed between runs: success, what was done, actions of reruns, attention",
        (*_ROWS, *_GROUPING, "allow_mismatch", "units"),
        examples=(
            "compare runs/base.zarr runs/tuned.zarr",
            "compare base=runs/a.zarr,runs/b.zarr tuned=runs/c.zarr,runs/d.zarr",
            "compare runs/base.zarr runs/without_visual.zarr runs/noise.zarr",
            "compare runs/libero_spatial.zarr runs/libero_goal.zarr --allow-mismatch suite",
        ),
        runs=True,
    ),
    "overlay": Command(
        "attention on the stored pictures: strips, GIF or MP4",
        (*_ROWS, *_GROUPING, *_STRIPS, "num_episodes", "num_replans"),
        ("image", "latent"),
        _NO_PICTURES,
        (
            "overlay runs/libero_10.zarr",
            "overlay runs/libero_10.zarr --task 3 --episode 1 --layers 13 --heads 5",
            "overlay runs/libero_10.zarr --outline bowl=object:akita_black_bowl_1 --video gif",
            "overlay runs/libero_10.zarr --replans 0 5 10 --cameras base_0_rgb",
        ),
    ),
    "report": Command(
        "all of it in one HTML file",
        (*_ROWS, *_GROUPING, "units", "num_episodes", "num_replans", "open"),
        examples=("report runs/libero_10.zarr --open", "report runs/libero_10.zarr --output paper/report.html"),
        page=True,
    ),
    "view": Command("a page on which to explore: episodes, words, patches, heads, groups", folder=True),
    "store": Command(
        "copy: pack, merge or slim stores; verify: check and repair; outcomes: tell them later", folder=True, keeps=True
    ),
}
#: The command of `vla-attention analyze STORE`.
DEFAULT_COMMAND = "analyze"
