"""The tables of `docs/validation.md`, written into the page between marks from the file of results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.validation.known import CONTRASTS, NUMBERS, OTHER
from benchmarks.validation.mixing import CUTS, GROUPS, READ, READERS
from benchmarks.validation.policies import SHIPPED, TITLES
from benchmarks.validation.prediction import ATTENTION, BASELINE, FAMILIES
from vla_attention.analyze.render.numbers import format_number
from vla_attention.schemas.errors import BadArgument

Results = Mapping[str, Any]
_VERDICTS = {"separates": "**separates**", "wrong way": "**the wrong way round**", "does not": "does not", "-": "-"}


def with_interval(row: Mapping[str, Any] | None) -> str:
    """`value [low, high]`."""
    if row is None or row["value"] is None:
        return "-"
    if row["low"] is None:
        return format_number(row["value"])
    return f"{format_number(row['value'])} [{format_number(row['low'])}, {format_number(row['high'])}]"


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def policies_table(results: Results) -> str:
    rows = [
        (
            policy["name"],
            TITLES.get(policy["control"], "-"),
            policy["suite"],
            f"{policy['solved']} of {policy['episodes']}",
            f"{policy['rerun_difference']:.2g}",
            ", ".join(map(str, policy.get("left_out", ()))) or "-",
        )
        for policy in results["policies"]
    ]
    header = ("policy", "what is known", "suite", "solved", "unchanged calls differ by", "dimensions left out")
    return markdown(header, rows)


def known_table(results: Results, first: str, other: str, about: str) -> str:
    verdicts = {row["number"]: row for row in results["contrasts"] if row["contrast"] == f"{first}/{other}"}
    rows = []
    columns = (first, other, SHIPPED) if first == "words" else (first, other)
    for name, number in NUMBERS.items():
        if number.about != about or name not in verdicts:
            continue
        row = verdicts[name]
        count = f"{_VERDICTS[row['verdict']]} ({row['expected']} of {row['pairs']}"
        count += f", {row['wrong']} wrong)" if row["wrong"] else ")"
        verdict = count if row["pairs"] else "not in both"
        rows.append((number.title, *(_of_control(results, control, name) for control in columns), verdict))
    return markdown(("number", *(TITLES[control] for control in columns), "tells the first two apart"), rows)


def other_table(results: Results) -> str:
    controls = list(dict.fromkeys(policy["control"] for policy in results["policies"]))
    names = [name for name, number in NUMBERS.items() if number.about == OTHER]
    rows = [(NUMBERS[name].title, *(_of_control(results, control, name) for control in controls)) for name in names]
    return markdown(("number", *(TITLES.get(control, "-") for control in controls)), rows)


def _of_control(results: Results, control: str, number: str) -> str:
    chosen = [row for row in results["known"] if row["control"] == control and row["number"] == number]
    return "; ".join(with_interval(row) for row in sorted(chosen, key=lambda row: row["seed"])) or "-"


def prediction_table(results: Results, key: str = "prediction") -> str:
    rows = []
    for family, what in FAMILIES.items():
        of = {row["measure"]: row for row in results[key] if row["family"] == family}
        if not of:
            continue
        mass = of["mass"]
        hits = f"{100 * mass['highest']:.0f} % ({100 * mass['chance']:.0f} %)"
        cells = [with_interval(of.get(measure)) for measure in (*ATTENTION, BASELINE)]
        rows.append((f"{family}: {what}", f"{mass['items']:.0f}", *cells, hits))
    return markdown(("items", "number", *ATTENTION, "number of keys", "most mass is largest effect (chance)"), rows)


def mixing_table(results: Results) -> str:
    of = {(row["cut"], row["group"]): row for row in results["mixing"]}
    rows = []
    for cut, what in CUTS.items():
        cells = [with_interval(of.get((cut, group))) for group in GROUPS]
        rows.append((what, with_interval(of.get((cut, ""))), *cells))
    return markdown(("in the prefix", "effect of the cut", *(f"without {what}" for what in GROUPS.values())), rows)


def readers_table(results: Results) -> str:
    of = {(row["cut"], row["group"]): row for row in results["mixing"]}
    rows = [(what, *(with_interval(of.get((reader, group))) for group in READ)) for reader, what in READERS.items()]
    return markdown(("who cannot read them", *(f"without {what}" for what in READ.values())), rows)


def success_table(results: Results) -> str:
    rows = [
        (row["policy"], row["condition"], f"{row['solved']} of {row['episodes']}") for row in results.get("success", ())
    ]
    return markdown(("policy", "rollouts with", "solved"), rows)


def blocks(results: Results) -> dict[str, str]:
    """Name of a mark -> its text; only of what the results hold."""
    made: dict[str, Callable[[], str]] = {"policies": lambda: policies_table(results)}
    present = {policy["control"] for policy in results["policies"]}
    for first, other, about in CONTRASTS:
        if {first, other} <= present:
            made[f"{first}/{other}"] = partial(known_table, results, first, other, about)
    if results.get("known"):
        made["other"] = lambda: other_table(results)
    if results.get("prediction_everywhere"):
        made["prediction everywhere"] = lambda: prediction_table(results, "prediction_everywhere")
    for name, key, make in (
        ("prediction", "prediction", prediction_table),
        ("mixing", "mixing", mixing_table),
        ("readers", "mixing", readers_table),
        ("success", "success", success_table),
    ):
        if results.get(key):
            made[name] = partial(make, results)
    return {name: make() for name, make in made.items()}


def fill_page(page: Path, results: Results) -> None:
    """Replace what stands between the marks `<!-- NAME -->` and `<!-- end NAME -->`."""
    text = page.read_text(encoding="utf-8")
    for name, block in blocks(results).items():
        begin, end = f"<!-- {name} -->", f"<!-- end {name} -->"
        if begin not in text or end not in text:
            raise BadArgument(f"{page} has no marks '{begin}' and '{end}' to write the table between.")
        head, rest = text.split(begin, 1)
        text = f"{head}{begin}\n\n{block}\n\n{end}{rest.split(end, 1)[1]}"
    page.write_text(text, encoding="utf-8")


def tables_text(results: Results) -> str:
    """All tables one after the other, for checkpoints of one's own."""
    return "\n\n".join(f"## {name}\n\n{block}" for name, block in blocks(results).items()) + "\n"
