"""`va.language_test`: whether a policy of any kind does something else when it is told something else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.result import Column, Finding, Result, Table
from vla_attention.analyze.render.answer import Answer
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument, plural

#: Smaller changes than this part of how far actions spread are rounding.
_ROUNDING = 1e-6
_AGAIN = "the same sentence again"
_GETS_THROUGH, _LISTENS = "Do the words get through?", "Does it listen?"


def language_test(
    call: Callable[[Any, str], Any],
    inputs: Sequence[tuple[Any, str]],
    prompts: Mapping[str, str | Sequence[str]] | Sequence[str],
) -> Answer:
    """Call a policy with other sentences on the same inputs; prints and returns how far its actions change.

    Nothing is recorded, and neither torch nor a simulator is needed. A change is the root mean square over a chunk, in
    units of how far each dimension of the action spreads over all inputs, or, for a dimension in which the inputs do
    not differ, of its root mean square change over all calls. Beside it stands the change when the same sentence is
    given again, which is that of the policy's own noise: draw it anew in every call, as in a rollout.

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
    plain = [_actions(call(*given)) for given in inputs]
    if len({actions.shape for actions in plain}) > 1:
        raise BadArgument(f"The calls gave actions of the shapes {sorted({one.shape for one in plain})}; expected one.")
    rows: list[dict[str, Any]] = []
    changes = []
    for number, ((observation, own), actions) in enumerate(zip(inputs, plain, strict=True)):
        for kind, text in [(_AGAIN, own), *((kind, text) for kind, text in texts if text != own)]:
            made = _actions(call(observation, text))
            if made.shape != actions.shape:
                raise BadArgument(f"Told '{text}', the actions have the shape {made.shape}, not {actions.shape}.")
            rows.append({"suite": "", "task_id": number, "instruction": own, "kind": kind, "told": text})
            changes.append(made - actions)
    spread = np.concatenate(plain).std(axis=0)
    spread = np.where(spread > 0, spread, np.sqrt(np.mean(np.square(changes), axis=(0, 1))))
    if not spread.any():
        raise BadArgument("All actions of all calls are the same: give inputs at which it does something else.")
    sizes = np.sqrt(np.mean((np.array(changes)[..., spread > 0] / spread[spread > 0]) ** 2, axis=(1, 2)))
    told = pl.DataFrame(rows).with_columns(change=pl.Series(sizes))
    again = told.filter(kind=_AGAIN).select("task_id", again="change")
    each = told.join(again, on="task_id", how="left", maintain_order="left")
    per_input = each.group_by("suite", "task_id", "kind", maintain_order=True).agg(pl.mean("change", "again"))
    quotients = {"times": ("change", "again")}
    found = estimate(per_input, ["kind"], {"change": "plain"}, Sampling(), quotients=quotients)
    answer = Answer.of(
        Result(
            "Does it listen? The same inputs, other sentences",
            [f"{plural(len(inputs), 'input')}, {plural(len(texts), 'other sentence')}."],
            _findings(found, each),
            [Table("sentences", found, _COLUMNS, "Change of the action"), Table("calls", each)],
        )
    )
    print(answer)
    return answer


def _findings(found: pl.DataFrame, each: pl.DataFrame) -> list[Finding]:
    others = each.filter(pl.col("kind") != _AGAIN)
    n, most = others.height, float(others["change"].to_numpy().max(initial=0.0))
    if most <= _ROUNDING:
        sentence = f"Nothing shows that they do: in {plural(n, 'call')} with other words the action is the same."
        limit = "Either the words do not reach the model (key of the data, tokenizer, prompt), or it is deaf."
        return [Finding(sentence, _GETS_THROUGH, {"change": most, "n": n}, limit)]
    top = found.filter(pl.col("kind") != _AGAIN).sort("change", descending=True).row(0, named=True)
    change = f"told '{top['kind']}' the action changes most, by {top['change']:.2g} of its spread"
    noise = float(each["again"].to_numpy().mean())
    times, low, high = (top[name] for name in ("times", "times_low", "times_high"))
    sentence, hears = f"Yes: with other words the action changes, by at most {most:.2g} of its spread.", True
    reach = Finding(sentence, _GETS_THROUGH, {"change": most, "n": n})
    if not noise:
        sentence = f"It hears: {change}; told the same again it does not change."
    elif low is not None and low > 1:
        sentence = f"It hears: {change}, {times:.2g} times [{low:.2g}, {high:.2g}] as much as told the same again."
    else:
        sentence, hears = f"Not shown to hear: {change}, and told the same again by {noise:.2g}.", False
    limit = "Another action need not be the right one: vla-attention capture exchange tries it in rollouts."
    listens = Finding(sentence, _LISTENS, {"change": top["change"], "times": times, "again": noise}, limit)
    return [reach, listens] if hears else [listens]  # what noise does as well shows no way of the words


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
]
