"""`va.language_test`: whether a policy of any kind does something else when it is told something else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.listening import ASK_THE_DATA
from vla_attention.analyze.core.result import Column, Finding, Result, Table
from vla_attention.analyze.render.answer import Answer
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument, listing, plural

#: Smaller changes than this part of how far actions spread count as none: no robot follows them, and a kernel that adds
#: up in another order, as prompts of other lengths make it do, gives as much in half precision.
SMALLEST = 1e-3
#: A dimension that moves by less than this part of the largest command is rounding as a whole.
_ROUNDING = 1e-6
_AGAIN = "the same sentence again"
_QUEUE = "A policy that hands out actions of an earlier chunk must be emptied in every call (LeRobot: policy.reset())."
_GETS_THROUGH, _LISTENS = "Do the words get through?", "Does it listen?"


def language_test(
    call: Callable[[Any, str], Any],
    inputs: Sequence[tuple[Any, str]],
    prompts: Mapping[str, str | Sequence[str]] | Sequence[str],
) -> Answer:
    """Call a policy with other sentences on the same inputs; prints and returns how far its actions change.

    Nothing is recorded, and neither torch nor a simulator is needed. Between the other sentences each input's own is
    told again, so that what drifts from call to call is not taken for hearing: an action that was told something else
    is compared with the mean of the own sentence's actions before and after it, and an own one in the same way, which
    is the policy's noise. Draw that anew in every call, as in a rollout, and empty a queue of actions first, in LeRobot
    by `policy.reset()`: an action that was planned before the sentence came does not know it.

    A change is the root mean square over a chunk, in units of how far each dimension of the action spreads over all
    inputs, or, for a dimension in which the inputs do not differ, of its root mean square change over all calls. Less
    than a thousandth counts as none. It hears where the change exceeds the noise (geometric mean over inputs, t) for a
    kind of sentence, at q <= 0.05 over all kinds.

    >>> import numpy as np
    >>> import vla_attention as va
    >>> def deaf(observation, instruction):
    ...     return np.outer(observation, np.ones(4))
    >>> found = va.language_test(deaf, [([0, 1], "lift it"), ([2, 1], "drop it")], ["wave"])  # doctest: +ELLIPSIS
    >>> found.findings[0].numbers["change"]
    0.0

    Args:
        call: (observation, instruction) -> actions, (horizon, action dim).
        inputs: pairs of an observation, as `call` takes it, and the instruction that belongs to it.
        prompts: the other sentences, or kind -> one sentence or several; each is told at every input. A sentence that
            is an input's own is left out there.

    Raises:
        BadArgument: fewer than two inputs, no prompt, actions of other shapes, or actions that never differ.
    """
    if not all(isinstance(given, tuple | list) and len(given) == 2 for given in inputs):
        raise BadArgument("An input is no pair; expected pairs (observation, instruction), as [(picture, 'lift it')].")
    kinds = prompts if isinstance(prompts, Mapping) else {text: text for text in prompts}
    texts = [(kind, text) for kind, given in kinds.items() for text in ([given] if isinstance(given, str) else given)]
    if not all(isinstance(text, str) for text in [*(text for _, text in texts), *(own for _, own in inputs)]):
        raise BadArgument("A prompt or an input's instruction is no text; expected pairs (observation, instruction).")
    others = sum(text != own for _, text in texts for _, own in inputs)
    if len(inputs) < 2 or not others:
        raise BadArgument(
            f"{plural(len(inputs), 'input')} and {plural(others, 'other sentence')} for them are too few; expected at "
            "least two inputs, pairs of an observation and its instruction, and a sentence that is not theirs."
        )
    rows: list[dict[str, Any]] = []
    changes: list[NDArray[np.float64]] = []
    plain: list[NDArray[np.float64]] = []
    for number, (observation, own) in enumerate(inputs):
        unlike = [(kind, text) for kind, text in texts if text != own]
        told = [own, *(text for _, other in unlike for text in (other, own)), *([own, own] if unlike else [])]
        made = [_actions(call(observation, text)) for text in told]
        plain.append(made[0])
        if len(shapes := {one.shape for one in (*made, plain[0])}) > 1:
            raise BadArgument(f"The calls gave actions of the shapes {sorted(shapes)}; expected one.")
        for place in range(1, 2 * len(unlike) + 1):
            # Another sentence stands between two of the own; of these, each between those before and after it.
            step = 1 if place % 2 else 2
            between = (made[place - step] + made[place + step]) / 2
            kind = unlike[place // 2][0] if place % 2 else _AGAIN
            rows.append({"suite": "", "task_id": number, "instruction": own, "kind": kind, "told": told[place]})
            changes.append(made[place] - between)
    sizes = _sizes(np.array(changes), np.array(plain))
    each = pl.DataFrame(rows).with_columns(change=pl.Series(sizes))
    per_input = each.group_by("suite", "task_id", "kind", maintain_order=True).agg(pl.mean("change"))
    again = per_input.filter(kind=_AGAIN).select("task_id", again="change")
    per_input = per_input.join(again, on="task_id", how="left", maintain_order="left")
    # What counts as none is as small as noise can be, so that there is a quotient without noise, too.
    times = pl.max_horizontal("change", pl.lit(SMALLEST)) / pl.max_horizontal("again", pl.lit(SMALLEST))
    per_input = per_input.with_columns(times=pl.when(pl.col("kind") != _AGAIN).then(times))
    num_kinds = per_input["kind"].n_unique() - 1
    found = estimate(
        per_input, ["kind"], {"change": "plain", "times": "geometric"}, Sampling(), {"times": 1.0},
        detect={"times": NAMED_AT / num_kinds},
    )  # fmt: skip
    answer = Answer.of(
        Result(
            "Does it listen? The same inputs, other sentences",
            [f"{plural(len(inputs), 'input')}, {plural(len(texts), 'other sentence')}."],
            _findings(found, each),
            [
                Table("sentences", found.drop("times_detectable"), _COLUMNS, "Change of the action"),
                Table("calls", each),
            ],
        )
    )
    print(answer)
    return answer


def _sizes(changes: NDArray[np.float64], plain: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far each call's action changes, (call,), in units of how far its dimensions spread.

    Args:
        changes: (call, horizon, action dim).
        plain: (input, horizon, action dim), the actions by which the inputs differ.

    Raises:
        BadArgument: no dimension differs between inputs, or changes by more than rounding.
    """
    flat = plain.reshape(-1, plain.shape[-1])
    spread, largest = flat.std(axis=0), np.abs(flat).max(axis=0)
    differs = spread > np.maximum(SMALLEST * largest, _ROUNDING * largest.max())
    # A dimension that is the same for all inputs has no spread to measure by. What moves it by more than rounding is
    # measured by its own changes: a gripper that only the words close.
    moved = np.abs(changes).max(axis=(0, 1))
    moves = moved > np.maximum(SMALLEST * largest, _ROUNDING * max(largest.max(), moved.max()))
    unit = np.where(differs, spread, np.sqrt(np.mean(np.square(changes), axis=(0, 1))))
    used = differs | moves
    if not used.any():
        raise BadArgument("All actions of all calls are the same: give inputs at which it does something else.")
    sizes: NDArray[np.float64] = np.sqrt(np.mean((changes[..., used] / unit[used]) ** 2, axis=(1, 2)))
    return sizes


def _findings(found: pl.DataFrame, each: pl.DataFrame) -> list[Finding]:
    is_other = pl.col("kind") != _AGAIN
    others, kinds = each.filter(is_other), found.filter(is_other).sort("change", descending=True)
    n, most = others.height, float(others["change"].to_numpy().max(initial=0.0))
    if most <= SMALLEST:
        sentence = f"Nothing shows that they do: in {plural(n, 'call')} with other words the action is the same."
        limit = f"Either the words do not reach the model (key of the data, tokenizer, prompt), or it is deaf. {_QUEUE}"
        return [Finding(sentence, _GETS_THROUGH, {"change": most, "n": n}, limit)]
    again = each.filter(~is_other)["change"].to_numpy()
    noise, quiet = float(again.mean()), bool(again.max() <= SMALLEST)
    # Without noise, every change is that of the words; else all kinds are looks at one question.
    shown = kinds.filter(
        pl.col("change") > SMALLEST if quiet else (pl.col("times_q") <= NAMED_AT) & (pl.col("times") > 1)
    )
    if shown.is_empty():
        top = kinds.row(0, named=True)
        change = f"told '{top['kind']}' the action changes by {top['change']:.2g} of its spread"
        sentence = f"Not shown to hear: {change}, and told the same again by {noise:.2g}."
        numbers = {"change": top["change"], "times": top["times"], "again": noise, "hears": 0}
        limit = f"{_could_show(top['times_detectable'])}{_QUEUE}"
        return [Finding(sentence, _LISTENS, numbers, limit, ASK_THE_DATA)]
    top = shown.row(0, named=True)
    sentence = f"It hears: told '{top['kind']}' the action changes by {top['change']:.2g} of its spread"
    if quiet:
        sentence += "; told the same again it does not change"
    else:
        sentence += f", {top['times']:.2g} times [{top['times_low']:.2g}, {top['times_high']:.2g}] as much as told the"
        sentence += " same again"
    if more := shown["kind"][1:].to_list():
        sentence += f"; also told {_quoted(more)}"
    if unheard := kinds.join(shown, on="kind", how="anti")["kind"].to_list():
        sentence += f"; {'the same' if quiet else 'not shown'} told {_quoted(unheard)}"
    reach = f"Yes: with other words the action changes, by at most {most:.2g} of its spread."
    limit = "Another action need not be the right one: vla-attention capture exchange tries it in rollouts."
    numbers = {"change": top["change"], "times": top["times"], "again": noise, "hears": shown.height}
    return [  # whether words get through is not said of what noise does as well
        Finding(reach, _GETS_THROUGH, {"change": most, "n": n}),
        Finding(f"{sentence}.", _LISTENS, numbers, limit),
    ]


def _quoted(kinds: Sequence[str]) -> str:
    return listing([f"'{kind}'" for kind in kinds], 5)


def _could_show(times: float | None) -> str:
    """What so many inputs could have shown; empty where nobody knows."""
    return f"So many inputs show {times:.2g} times the noise in 80% of tests. " if times and np.isfinite(times) else ""


def _actions(given: Any) -> NDArray[np.float64]:
    """Actions as (horizon, action dim); a tensor's numbers wherever it is, a batch of one without its axis."""
    values = given.detach().float().cpu().numpy() if hasattr(given, "detach") else given
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadArgument(f"A call gave {type(given).__name__}; expected actions, (horizon, action dim).") from None
    numbers = numbers[0] if numbers.ndim == 3 and len(numbers) == 1 else np.atleast_2d(numbers)
    if numbers.ndim != 2 or not numbers.size or not np.isfinite(numbers).all():
        raise BadArgument(
            f"A call gave actions of the shape {numbers.shape}, or NaN; expected finite ones, (horizon, action dim)."
        )
    return numbers


_COLUMNS = [
    Column("kind", "text", "told"),
    Column("num_episodes", "count", "inputs"),
    Column("change", "number", "change", "root mean square over a chunk, in units of the spread of each dimension"),
    Column("times", "factor", "times noise", "over the change when the same sentence is given again"),
    Column("times_q", "p", "q", "p of no more than noise, adjusted for the number of kinds (Benjamini-Hochberg)"),
]
