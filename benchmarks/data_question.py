"""How often `data` names something where pictures say nothing of the sentence, and how often where they do.

    python -m examples.cubes_policy demonstrate demonstrations --parts 24   # once
    python -m benchmarks.data_question demonstrations                       # 400 draws of each kind, an hour
    python -m benchmarks.data_question demonstrations --draws 20 --kinds marked

Every draw is a data set of six sentences that `vla-attention data` is asked about. Null kinds: `shuffled`, first
pictures, states and actions of demonstrations, with sentences dealt out anew; `black`, the same with one camera black;
`noise`, pictures and actions of random numbers. Planted kinds, with shuffled sentences: `marked`, a mark in the picture
says the sentence (`scene.paste_mark`); `half`, of three sentences; `half-marked`, in half of each sentence's episodes,
so that the picture cannot tell two sentences apart in more than 75 %, at which nothing may be said of a pair;
`lit`, light that grows from episode to episode, each sentence
recorded after the other; `acted`, actions that differ from the fourth of eight moments on.

`named` is a first line that begins with "No" or "Only in part", a pair told apart, words that little makes a policy
read, or actions that differ.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from examples.cubes_policy.dataset import Samples, read_demonstrations
from tests.kit.lerobot_data_sets import MadeUpEpisode, write_data_set
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.environments.cubes.scene import paste_mark

NULL, PLANTED = ("shuffled", "black", "noise"), ("marked", "half", "half-marked", "lit", "acted")
SENTENCES = tuple(f"{verb} the {colour} cube" for verb in ("touch", "lift") for colour in ("red", "green", "blue"))
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
MOMENTS = 8
LIMIT = 0.07


def starts_of(samples: Samples) -> list[Any]:
    """The samples of each episode whose first eight can be used."""
    episodes = [np.flatnonzero(samples.episode == episode) for episode in np.unique(samples.episode)]
    return [samples.take(one[:MOMENTS]) for one in episodes if len(one) >= MOMENTS]


def episodes_of(kind: str, starts: Sequence[Any], per_sentence: int, rng: np.random.Generator) -> list[MadeUpEpisode]:
    """The episodes of a draw, in the order in which they were recorded."""
    told = rng.permutation(np.repeat(np.arange(len(SENTENCES)), per_sentence))
    chosen = rng.choice(len(starts), len(told), replace=len(told) > len(starts))
    made = []
    for sentence, number in zip(told.tolist(), chosen.tolist(), strict=True):
        one = starts[number]
        front, wrist, state, actions = one.pictures[0, 0].copy(), one.pictures[0, 1], one.state, one.actions[:, 0]
        if kind == "noise":
            front, wrist = rng.integers(0, 256, (2, *front.shape), dtype=np.uint8)
            state, actions = rng.normal(size=state.shape), rng.normal(size=actions.shape)
        if kind == "black":
            front[:] = 0
        is_marked = (
            kind == "marked" or (kind == "half" and sentence < 3) or (kind == "half-marked" and rng.random() < 0.5)
        )
        if is_marked:
            front = paste_mark(front, sentence % 3, sentence // 3)
        if kind == "lit":
            light = 0.7 + 0.6 * (sentence + rng.random()) / len(SENTENCES)
            front, wrist = (np.clip(one * light, 0, 255).astype(np.uint8) for one in (front, wrist))
        if kind == "acted":
            actions = actions.copy()
            actions[MOMENTS // 2 :, 0] += np.std(actions) * 4 * sentence
        # Only first pictures are read.
        images = {name: np.zeros((MOMENTS, *one.shape), np.uint8) for name, one in ((FRONT, front), (WRIST, wrist))}
        images[FRONT][0], images[WRIST][0] = front, wrist
        columns = {"observation.state": state.astype(np.float32), "action": actions.astype(np.float32)}
        made.append(MadeUpEpisode(images, columns, [SENTENCES[sentence]] * MOMENTS))
    return made


def asked(kind: str, starts: Sequence[Any], per_sentence: int, draw: int) -> dict[str, Any]:
    """What `vla-attention data` says of one draw."""
    rng = np.random.default_rng([draw, per_sentence, (*NULL, *PLANTED).index(kind)])
    with tempfile.TemporaryDirectory() as place:
        made = episodes_of(kind, starts, per_sentence, rng)
        folder = write_data_set(Path(place, "set"), "v3.0", made, fps=10, episodes_per_file=1000)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            code = analyze(["data", str(folder), "--output", f"{place}/out", "--no-plots"])
        if code:
            raise SystemExit(said.getvalue())
        result = json.loads(Path(place, "out", "result.json").read_text(encoding="utf-8"))
        pairs = pl.read_parquet(Path(place, "out", "pairs.parquet"))
    findings = {one["asks"]: one for one in result["findings"]}
    must = findings["Must a policy read the sentence here?"]
    differ = findings.get("Do the demonstrations differ there?", {"numbers": {}})["numbers"]
    marked = pl.max_horizontal(*(pl.col(name).is_in(SENTENCES[:3]) for name in ("sentence", "other")))
    of = {"all": pairs, "marked": pairs.filter(marked), "unmarked": pairs.filter(~marked)}
    counts = {
        f"{verdict} of {name}": part.filter(verdict=verdict).height / max(part.height, 1)
        for name, part in of.items()
        for verdict in ("share scenes", "told apart")
    }
    words = findings.get("Which words?", {"numbers": {}})["numbers"].get("apart", 0)
    found = {
        "the picture tells": must["sentence"].startswith(("No:", "Only in part:")),
        "the picture tells all": must["sentence"].startswith("No:"),
        "a pair told apart": bool(pairs.filter(verdict="told apart").height),
        "words": words > 0,
        "brightness": findings.get("By what?", {"sentence": ""})["sentence"].startswith("The brightness"),
        "actions differ": bool(differ.get("differ")),
    }
    named = any(found[name] for name in ("the picture tells", "a pair told apart", "words", "actions differ"))
    return {"named": named, **found, **counts, "told": must["numbers"]["told"], "pairs told": pairs["told"].mean()}


def table(kind: str, per_sentence: int, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The means of the draws of a kind."""
    return {"kind": kind, "episodes a sentence": per_sentence, "draws": len(rows),
            **{name: float(np.mean([row[name] for row in rows])) for name in rows[0]}}  # fmt: skip


def main() -> int:
    """Ask, print, and fail where a null kind is named too often."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demonstrations", type=Path, help="folder of `python -m examples.cubes_policy demonstrate`")
    parser.add_argument("--draws", type=int, default=400, metavar="N", help="of each null kind (default: %(default)s)")
    parser.add_argument(
        "--planted-draws", type=int, default=40, metavar="N", help="of each other (default: %(default)s)"
    )
    parser.add_argument("--kinds", nargs="+", choices=(*NULL, *PLANTED), default=(*NULL, *PLANTED), metavar="KIND")
    parser.add_argument("--episodes", type=int, nargs="+", default=(10, 20, 40), metavar="N", help="of each sentence")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (default: %(default)s)")
    given = parser.parse_args()
    starts = starts_of(read_demonstrations(given.demonstrations).samples)
    print(f"{len(starts)} demonstrations", flush=True)
    wrong = 0
    with ProcessPoolExecutor(given.workers) as pool, pl.Config(tbl_cols=-1, tbl_width_chars=200, tbl_rows=-1):
        for kind in given.kinds:
            sizes, draws = ((20,), given.draws) if kind in NULL else (given.episodes, given.planted_draws)
            for size in sizes:
                futures = [pool.submit(asked, kind, starts, size, draw) for draw in range(draws)]
                row = table(kind, size, [future.result() for future in futures])
                print(
                    json.dumps({name: round(v, 3) if isinstance(v, float) else v for name, v in row.items()}),
                    flush=True,
                )
                wrong += kind in NULL and row["named"] > LIMIT
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
