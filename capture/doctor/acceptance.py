"""`doctor --accept`: ten episodes of a published checkpoint, held against its published success rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from vla_attention.capture.policies.family import PolicyFamily, PublishedRate
from vla_attention.schemas.errors import BadArgument, listing

_LEVEL = 0.95


def at_most(successes: int, count: int, rate: float) -> float:
    """Return the probability of at most `successes` of `count` at a rate of success."""
    if successes >= count or rate <= 0:
        return 1.0
    if successes < 0 or rate >= 1:
        return 0.0
    logs = [
        math.lgamma(count + 1)
        - math.lgamma(k + 1)
        - math.lgamma(count - k + 1)
        + k * math.log(rate)
        + (count - k) * math.log1p(-rate)
        for k in range(successes + 1)
    ]
    return min(1.0, math.fsum(map(math.exp, logs)))


def exact_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate by Clopper and Pearson (1934): it covers the rate at least that often."""
    if not 0 <= successes <= count or count < 1:
        raise ValueError(f"{successes} of {count} is no number of successes")
    tail = (1 - _LEVEL) / 2
    # The highest rate at which so few, and the lowest at which so many successes are not yet improbable.
    low = 0.0 if successes == 0 else _solve(lambda rate: 1 - at_most(successes - 1, count, rate) - tail)
    high = 1.0 if successes == count else _solve(lambda rate: tail - at_most(successes, count, rate))
    return low, high


def most_that_is_too_few(count: int, lowest_rate: float) -> int:
    """Return the largest number of successes whose interval lies below `lowest_rate`; -1 if there is none."""
    return max((k for k in range(count) if exact_interval(k, count)[1] < lowest_rate), default=-1)


def rate_found_in_nine_of_ten(count: int, too_few: int) -> float:
    """Return the rate of success at which nine of ten trials of `count` episodes have at most `too_few` successes."""
    return 0.0 if too_few < 0 else _solve(lambda rate: 0.9 - at_most(too_few, count, rate))


def _solve(rising: Callable[[float], float]) -> float:
    """Return where a function that rises from a rate of 0 to 1 is zero."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if rising(middle) > 0 else (middle, high)
    return (low + high) / 2


#: Episodes of an acceptance run: minutes on a GPU, and enough to tell a defect from a policy that works.
EPISODES = 10


@dataclass(frozen=True)
class Verdict:
    """Whether a policy was accepted, and the lines that say why."""

    accepted: bool
    lines: tuple[str, ...]


def find_published_rate(
    checkpoint: str, suite: str | None, family: PolicyFamily, given: float | None = None
) -> PublishedRate:
    """Return the published rate of a checkpoint: by its name, or by the name of its folder.

    suite: None takes the first for which there is a rate. given: the value of `--published-rate`, which counts like a
    rate of 500 episodes.

    Raises:
        BadArgument: no rate is known; the ones that are, are listed.
    """
    if given is not None:
        if not 0 < given <= 1:
            raise BadArgument(
                f"Cannot use --published-rate {given}; expected a share above 0, at most 1, such as 0.97."
            )
        return PublishedRate(checkpoint, suite or family.default_suite, round(500 * given), 500, "--published-rate")
    name = PurePath(checkpoint.rstrip("/")).name.partition("@")[0]
    known = [rate for rate in family.published_rates if PurePath(rate.checkpoint).name == name]
    of_suite = [rate for rate in known if suite in (None, rate.suite)]
    if of_suite:
        return of_suite[0]
    if known:
        raise BadArgument(
            f"No success rate of {name} in the suite '{suite}' is known; it has one in "
            f"{listing(rate.suite for rate in known)}. Give one of these as --task-suite, or --published-rate."
        )
    names = dict.fromkeys(rate.checkpoint for rate in family.published_rates)
    raise BadArgument(
        f"No success rate of the checkpoint '{checkpoint}' is known; there are rates of {listing(names)}, and of "
        "folders of these names. Give --published-rate with the share of episodes that it should solve."
    )


def share_of_tasks(num_tasks: int) -> tuple[int, int]:
    """Return how many tasks, and how many episodes of each, make ten episodes."""
    tasks = max(number for number in (10, 5, 2, 1) if number <= num_tasks)
    return tasks, EPISODES // tasks


def judge(solved: int, episodes: int, published: PublishedRate, failed: Sequence[str] = ()) -> Verdict:
    """Hold what a run solved against the published rate.

    The policy is not accepted where the run's exact 95 % interval lies below that of the published evaluation, which is
    a number of episodes, too. failed: what was not solved, for the text.
    """
    low, high = exact_interval(solved, episodes)
    published_low, published_high = exact_interval(published.solved, published.episodes)
    too_few = most_that_is_too_few(episodes, published_low)
    lines = [
        f"Solved {solved} of {episodes} episodes of {published.suite}: {solved / episodes:.0%} (95 % interval "
        f"{low:.1%} to {high:.1%}).",
        f"Published: {published.solved / published.episodes:.1%} of {published.episodes} episodes "
        f"({published_low:.1%} to {published_high:.1%}), {published.source}.",
    ]
    if failed:
        lines.append(f"Not solved: {listing(failed)}.")
    accepted = solved > too_few
    if accepted:
        lines.append("Accepted: the two intervals overlap, so nothing here says that it solves less than published.")
    else:
        lines.append(
            "NOT accepted: the interval is below the published one. Look at the lines above for what was loaded "
            "(format, configuration, precision, normalisation, prompt, cameras), at the protocol (docs/protocol.md), "
            "and run vla-attention capture parity on a case of the reference implementation."
        )
    if too_few >= 0:
        rate = rate_found_in_nine_of_ten(episodes, too_few)
        lines.append(
            f"What {episodes} episodes can tell: {too_few} solved or fewer are too few; a policy that solves "
            f"{rate:.0%} is found out in nine of ten such runs, and one that solves more less often."
        )
    else:
        lines.append(f"What {episodes} episodes can tell: nothing; to solve none would agree with the published rate.")
    return Verdict(accepted, tuple(lines))
