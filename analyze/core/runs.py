"""The runs of a comparison: their stores, and the fields in which they must agree.

Two runs may differ in the weights and in their names (policy name, checkpoint, digest). Everything else that affects
the numbers must be equal, or be allowed by name (`--allow-mismatch FIELD`). A note names different versions of Python,
torch and the like, which hardly affect them. A rerun repeats the policy calls of another run under a change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.schemas.errors import BadArgument, UnknownName, UserError, did_you_mean, listing
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_url import StorePlace, store_place


class MixedPolicies(UserError, ValueError):
    """Policies of different families, or different softmaxes, in one comparison."""


class RunsDiffer(UserError, ValueError):
    """Runs that differ in something other than what is compared."""


@dataclass(frozen=True)
class RunArgument:
    """One run as the user gives it: a name and the paths of its stores."""

    name: str
    paths: tuple[StorePlace, ...]


@dataclass(frozen=True)
class Run:
    """A run: its name, and the question about its own stores. All runs of a comparison have the same settings."""

    name: str
    question: Question

    @property
    def stores(self) -> tuple[Store, ...]:
        """The stores of the run."""
        return self.question.stores

    def repeats(self, other: Run) -> bool:
        """Whether this run repeats the policy calls of another one."""
        sources = [store.attributes.rerun_of for store in self.stores]
        runs = {store.run for store in other.stores}
        return all(source is not None and source.run in runs for source in sources)

    @property
    def changed(self) -> str:
        """What interventions changed in it, in words."""
        return listing(dict.fromkeys(visible(store.attributes.interventions.describe()) for store in self.stores))

    @property
    def suites(self) -> tuple[str, ...]:
        """The suites of the run's stores, in alphabetical order."""
        return tuple(sorted({store.suite for store in self.stores}))


def parse_runs(texts: Sequence[str]) -> list[RunArgument]:
    """Read STORE or NAME=STORE[,STORE ...], two or more of them; a store alone is named after its file.

    Stores of one file name (one folder per policy, one store per suite) are named with as many of their folders as
    tells them apart.

    Raises:
        BadArgument: fewer than two, a name or a store given twice, an empty name or path.
    """
    runs = []
    for text in texts:
        # A path may hold '=' too: what exists as it stands is a path.
        name, given, rest = ("", "", text) if Path(text).exists() else text.rpartition("=")
        paths = tuple(store_place(part) for part in rest.split(","))
        if (given and not name) or not all(rest.split(",")):
            raise BadArgument(f"Cannot read the run '{text}'; expected STORE or NAME=STORE[,STORE ...].")
        if not given and len(paths) > 1:
            raise BadArgument(f"The run '{text}' has {len(paths)} stores and no name; write NAME={text}.")
        runs.append(RunArgument(name, paths))
    unnamed = [run.paths[0] for run in runs if not run.name]
    runs = [run if run.name else RunArgument(_name_among(run.paths[0], unnamed), run.paths) for run in runs]
    if len(runs) < 2:
        raise BadArgument("A comparison needs two runs or more; look at one with vla-attention analyze.")
    places = [path.resolve() for run in runs for path in run.paths]
    for path in (path for run in runs for path in run.paths):
        if places.count(path.resolve()) > 1:
            raise BadArgument(f"The store {path} is given twice; a run compared with itself differs in nothing.")
    names = [run.name for run in runs]
    for name in names:
        if names.count(name) > 1:
            raise BadArgument(f"Two runs are named '{name}'; name them apart with NAME=STORE.")
    return runs


def _name_among(path: StorePlace, others: Sequence[StorePlace]) -> str:
    """The end of a store's path, without suffix, that no other one ends with; at least its file name."""

    def end(of: StorePlace, depth: int) -> str:
        return "/".join(of.resolve().with_suffix("").parts[-depth:])

    depth = 1
    rivals = [other for other in others if other.resolve() != path.resolve()]
    while any(end(path, depth) == end(other, depth) for other in rivals) and depth < len(path.resolve().parts):
        depth += 1
    return end(path, depth)


def open_runs(arguments: Sequence[RunArgument], settings: AnalysisSettings, allowed: Sequence[str] = ()) -> list[Run]:
    """Open every run's stores and ask the same of each; the groups must come out with the same names.

    Raises:
        UnknownName: an allowed field does not exist.
        MixedPolicies: families differ and "family" is not allowed, or they have no site in common.
        UserError: what `question.ask` raises, or a grouping that has other groups in one run than in another.
    """
    check_fields(allowed)
    opened = [(argument, [open_store(path) for path in argument.paths]) for argument in arguments]
    # Said before anything else: a name that one policy knows and another does not would only be its consequence.
    _refuse_families([(argument.name, stores[0]) for argument, stores in opened], "family" in allowed)
    runs = [Run(argument.name, ask(stores, settings)) for argument, stores in opened]
    first = runs[0]
    for run in runs[1:]:
        if run.question.grouping.names != first.question.grouping.names:
            differing = set(run.question.grouping.names) ^ set(first.question.grouping.names)
            raise BadArgument(
                f"Grouping '{run.question.grouping.name}' has other groups in {run.name} than in {first.name} "
                f"({listing(sorted(differing))}); compare with a grouping that both can fill, such as default."
            )
    return runs


#: Entries of the provenance that affect what the policy sees; differences in others are only noted.
_SIMULATOR = ("mujoco", "robosuite", "hf-libero", "assets")
#: Entries that are measured anew in every episode, or are the task's; they say nothing about how runs were captured.
_MEASURED = ("task file says", "largest P·V error", "replan blocks without attention", "difference to own setting")
#: Entries of the policy's configuration that belong to the weights.
_NAMES_OF_WEIGHTS = ("configuration", "config_name", "statistics", "config")

#: Field -> why it matters, in the order of messages.
FIELDS = {
    "family": "policies of other families attend over other keys",
    "suite": "other suites have other tasks",
    "seed": "it seeds environment and noise",
    "protocol": "resets are seeded in other ways",
    "image_size": "the simulator drew other pictures",
    "wait_steps": "episodes begin elsewhere",
    "replan_steps": "policy calls are made at other moments",
    "max_steps": "failed episodes have other lengths",
    "layers": "averages over other layers",
    "denoise_steps": "averages over other denoise steps",
    "heads": "averages over other heads",
    "queries": "averages over other queries",
    "depth": "equal numbers stand for other layers, heads and denoise steps",
    "layout": "other tokens, and with them another even spread",
    "cameras": "the policies are shown other pictures",
    "processing": "observations and prompts are prepared in other ways",
    "simulator": "other versions of the simulator",
}


def _fields(run: Run) -> dict[str, Any]:
    """The values of `FIELDS` in a run: texts, numbers, tuples of them, or mappings."""
    root, question = run.stores[0].attributes, run.question
    policy, recording, provenance = root.policy, root.recording_of(question.site), _provenance(run)
    of_stores = {
        name: tuple(sorted({getattr(store.attributes.protocol, name) for store in run.stores}))
        for name in ("seed", "name", "image_size", "wait_steps", "replan_steps", "max_steps")
    }
    return of_stores | {
        "family": policy.family,
        "suite": run.suites,
        "protocol": of_stores["name"],
        "layers": question.selection.blocks,
        "denoise_steps": question.selection.denoise_steps,
        "heads": question.selection.head_numbers,
        "queries": (recording.queries, recording.num_action_queries, recording.num_pools),
        "depth": (policy.num_layers, policy.num_heads, policy.num_denoise_steps),
        "layout": _layout(root.site(question.site)),
        "cameras": policy.cameras,
        "processing": {name: value for name, value in policy.config.items() if name not in _NAMES_OF_WEIGHTS},
        "simulator": {name: value for name, value in provenance.items() if name in _SIMULATOR},
    }


def check_fields(allowed: Sequence[str]) -> None:
    """Raise `UnknownName` for a field that cannot be allowed to differ."""
    for field in allowed:
        if field not in FIELDS:
            raise UnknownName(
                f"Unknown field '{field}' in --allow-mismatch.{did_you_mean(field, FIELDS)} Existing: "
                f"{listing(FIELDS, 40)}."
            )


def check_comparable(runs: Sequence[Run], allowed: Sequence[str]) -> list[str]:
    """Raise unless all runs agree in every field that is not allowed to differ; returns a line on each that does.

    With `suite` allowed, `max_steps` may differ as well: it belongs to the suite.

    Raises:
        MixedPolicies: the runs' sites differ, which cannot be allowed.
        RunsDiffer: any field.
    """
    first = runs[0]
    for run in runs[1:]:
        if run.question.site != first.question.site:
            raise MixedPolicies(
                f"Runs {first.name} and {run.name} would be compared at different sites ({first.question.site} and "
                f"{run.question.site}): different softmaxes over different tokens, whose masses cannot be compared; "
                "choose a site that both have with --site."
            )
    waived = {*allowed, *(("max_steps",) if "suite" in allowed and len({run.suites for run in runs}) > 1 else ())}
    notes, of_first = [], _fields(first)
    for run in runs[1:]:
        of_run = _fields(run)
        differing = {name: _difference(of_first[name], of_run[name]) for name in FIELDS}
        differences = {name: text for name, text in differing.items() if text}
        refused = [name for name in differences if name not in waived]
        if refused:
            named = "; ".join(f"{name}: {differences[name]}" for name in refused)
            # Allowing another suite allows its other number of steps.
            to_allow = [name for name in refused if name != "max_steps" or "suite" not in refused]
            flags = " ".join(f"--allow-mismatch {name}" for name in to_allow)
            choices = {"layers": "--layers", "denoise_steps": "--denoise", "heads": "--heads"}
            chosen = [choices[name] for name in refused if name in choices]
            usable = f", choose what both recorded with {listing(chosen)}" if chosen else ""
            raise RunsDiffer(
                f"Runs {first.name} and {run.name} differ in more than their weights ({named}): "
                f"{FIELDS[refused[0]]}; capture them alike{usable}, or compare all the same with "
                f"{flags}."
            )
        notes += [
            f"{first.name} and {run.name} differ in {name} ({text}), as allowed." for name, text in differences.items()
        ]
    return notes


def noted_differences(runs: Sequence[Run]) -> list[str]:
    """A line per run whose software or machine differs from the first one's, which is no reason to refuse it."""
    first, notes = runs[0], []
    for run in runs[1:]:
        mine, theirs = _provenance(first), _provenance(run)
        others = [name for name in {**mine, **theirs} if name not in (*_SIMULATOR, *_MEASURED)]
        names = [name for name in others if mine.get(name) != theirs.get(name)]
        if names:
            pairs = [f"{name} {mine.get(name, 'unknown')} and {theirs.get(name, 'unknown')}" for name in names]
            notes.append(f"{first.name} and {run.name} were captured with different {listing(pairs)}.")
    return notes


def _refuse_families(stores: Sequence[tuple[str, Store]], allowed: bool) -> None:
    """Refuse mixed families, unless allowed and with a site of the same name in both."""
    name, first = stores[0]
    for other_name, other in stores[1:]:
        family, other_family = first.attributes.policy.family, other.attributes.policy.family
        sites, other_sites = ([site.name for site in store.attributes.sites] for store in (first, other))
        what = f"Runs {name} and {other_name} mix policies, {family} and {other_family}"
        if family != other_family and not set(sites) & set(other_sites):
            raise MixedPolicies(
                f"{what}, which have no site in common ({listing(sites)}; {listing(other_sites)}): their softmaxes are "
                "over different tokens, and their masses cannot be compared; ask each with vla-attention analyze."
            )
        if family != other_family and not allowed:
            raise MixedPolicies(
                f"{what}, which attend over different tokens, so that an even spread differs; if lifts and ratios at a "
                "site of the same name are to be compared all the same, give --allow-mismatch family."
            )


def _difference(mine: Any, theirs: Any) -> str:
    """How two values of a field differ, or an empty string."""
    if mine == theirs:
        return ""
    if isinstance(mine, Mapping):
        names = [name for name in {**mine, **theirs} if mine.get(name) != theirs.get(name)]
        return listing([f"{name} {_shown(mine.get(name))} and {_shown(theirs.get(name))}" for name in names], 4)
    return f"{_shown(mine)} and {_shown(theirs)}"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        items = [getattr(item, "name", item) for item in value]
        return listing(items, 6) if len({str(item) for item in items}) else "none"
    text = str(value)
    return text if len(text) <= 40 else text[:39] + "…"


def _layout(site: SiteLayout) -> dict[str, str]:
    """Span of a site -> its keys, camera and grid, as text."""
    spans = {}
    for span in site.spans:
        grid = f" of {span.grid.describe()}" if span.grid else ""
        camera = f" of camera {span.camera}" if span.camera not in (None, span.name) else ""
        spans[span.name] = f"keys {span.start}-{span.stop - 1}{camera}{grid}{', growing' if span.growing else ''}"
    return spans


def _provenance(run: Run) -> dict[str, str]:
    """Software and machine of the run's episodes, which several jobs may have captured; the root has the first's."""
    values_by_name: dict[str, dict[str, None]] = {}
    for item in run.question.selected:
        for name, value in item.episode.attributes.provenance.items():
            values_by_name.setdefault(name, {})[value] = None
    return {name: listing(values) for name, values in values_by_name.items()}
