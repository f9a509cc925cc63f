"""What stores hold: as names and texts, in a few lines, as a table of episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import polars as pl

from vla_attention.analyze.stores.parallel import read_ahead
from vla_attention.analyze.stores.selection import select_episodes
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.selectors import SELECTOR_KINDS
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Names
from vla_attention.schemas.groupings.words import words_of
from vla_attention.schemas.layers import block_of_labels
from vla_attention.schemas.layout import Role, Span
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, is_half, key_error_bound, mass_error_bound
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import Protocol, RootAttributes

#: Attributes of an episode that are columns of `episodes_table`.
_EPISODE_COLUMNS = (
    "task_id",
    "task_name",
    "task_family",
    "instruction",
    "episode_index",
    "initial_state_index",
    "success",
    "num_steps",
    "num_replans",
)


def episodes_table(stores: Sequence[Store]) -> pl.DataFrame:
    """One row per episode: store, suite and `_EPISODE_COLUMNS`, from the attributes."""
    rows = [
        {"store": str(store.path), "suite": store.suite}
        | {name: getattr(episode.attributes, name) for name in _EPISODE_COLUMNS}
        | {name: visible(getattr(episode.attributes, name)) for name in ("instruction", "task_family")}
        for store in stores
        for episode in read_one_by_one(store.episodes)
    ]
    return pl.DataFrame(rows, schema_overrides={"task_id": pl.Int64})


def read_one_by_one(episodes: Iterable[StoredEpisode]) -> Iterator[StoredEpisode]:
    """The same episodes, each made anew: what is read of one is gone when the next one is read.

    What an episode keeps when it was read (its seal lists every file) is 20 kB, of thousands of episodes too much.
    """
    return read_ahead(replace(episode) for episode in episodes)


def one_line(stores: Sequence[Store]) -> str:
    """Numbers of stores, episodes, tasks, solved episodes and replans, and the suites."""
    success, replans = [], 0
    for episode in read_one_by_one(episode for store in stores for episode in store.episodes):
        success.append(episode.attributes.success)
        replans += episode.attributes.num_replans
    tasks = {(store.suite, task) for store in stores for task in store.task_ids}
    held = f"{plural(len(success), 'episode')} of {plural(len(tasks), 'task')} ({_solved_text(success)})"
    suites = listing(dict.fromkeys(store.suite for store in stores))
    return f"{plural(len(stores), 'store')}: {held}, {replans} replans, suite {suites}"


def _solved_text(outcomes: Iterable[bool | None]) -> str:
    """`3 solved`; `3 of 5 with a known outcome solved` where some are not known, `outcomes not known` where all are."""
    given = list(outcomes)
    known = [outcome for outcome in given if outcome is not None]
    if given and not known:
        return "outcomes not known"
    solved = sum(known)
    return f"{solved} solved" if len(known) == len(given) else f"{solved} of {len(known)} with a known outcome solved"


def lines_of_store(store: Store, tasks: Sequence[int | str] | None = None) -> Iterator[tuple[str, str]]:
    """What a store holds, as names and texts: run, recorded axes, spans and roles of every site, tasks, objects."""
    episodes = select_episodes(store, tasks)
    root = store.attributes
    policy, recording, protocol = root.policy, root.recording, root.protocol
    yield "store", str(store.path)
    yield "policy", f"{policy.name} ({policy.family}), {policy.checkpoint_format}: {policy.checkpoint}"
    yield "weights", f"{policy.digest[:16]}{'  UNTRAINED random weights' if policy.untrained else ''}"
    yield "run", f"suite {protocol.suite}, protocol {protocol_text(protocol)}"
    if root.data_set is not None:
        yield "data set", root.data_set.describe()
    success: list[bool | None] = []
    of_tasks: dict[int, tuple[str, str]] = {}  # instruction, and objects of interest in the first episode
    num_episodes: Counter[int] = Counter()
    first: dict[str, EpisodeTokens] = {}
    names = {site.name: Names(site) for site in root.sites}
    for episode in read_one_by_one(episodes):
        attributes = episode.attributes
        success.append(attributes.success)
        num_episodes[attributes.task_id] += 1
        interest = listing([thing.name for thing in attributes.objects if thing.of_interest])
        of_tasks.setdefault(attributes.task_id, (visible(attributes.instruction), interest))
        for site in root.sites:
            if site.name not in first:
                first[site.name] = episode.tokens(root, site.name)
            # Words and objects are in the attributes: no array of the other episodes is read.
            names[site.name].add_words(words_of(prompt) for prompt in episode.prompts(root, site.name))
            if episode.coverage(root, site.name):
                names[site.name].add_objects(attributes.objects)
    yield "episodes", f"{len(episodes)} ({_solved_text(success)}), tasks {listing(store.task_ids, 100)}"
    labels = [
        f"{label} (block {block})" if label != block else str(block)
        for label, block in zip(
            recording.layer_labels, block_of_labels(recording.layer_labels, policy.num_layers), strict=True
        )
    ]
    yield "layers", f"{listing(labels, 40)} of {policy.num_layers}"
    yield "denoise", f"steps {listing(recording.denoise_steps, 40)} of {policy.num_denoise_steps}"
    yield "heads", listing(recording.heads, 40)
    yield "queries", f"{recording.queries} over {recording.num_action_queries} action queries"
    bits = recording.mantissa_bits
    tiny = f" and {key_error_bound(bits):.1e} for each token" if is_half(bits) else ""
    exact = bits == FLOAT32_MANTISSA_BITS
    error = "exact" if exact else f"masses within {mass_error_bound(bits):.1e} (relative){tiny}"
    yield "computed in", str(policy.config.get("dtype", "not stated"))
    yield "precision", f"{bits} mantissa bits: {error}"
    for site in root.sites:
        note = f" ({own_parts(root, site.name)})" if site.layers or site.heads or site.num_action_queries else ""
        yield f"site {site.name}", f"{site.num_keys} keys{note}; span, keys, roles (their number at the first replan)"
        for span in site.spans:
            yield "  span", _describe_span(span, first[site.name])
        vocabulary = names[site.name].vocabulary()
        yield "  words", listing(vocabulary.words, 200)
        yield "  objects", listing(vocabulary.objects, 200)
    for task, (instruction, interest) in of_tasks.items():
        held = f"({plural(num_episodes[task], 'episode')}; objects of interest: {interest})"
        yield f"task {task}", f"{instruction}  {held}"
    for name, kind in SELECTOR_KINDS.items():
        yield f"{name}:", f"takes {kind.takes}"


def _describe_span(span: Span, tokens: EpisodeTokens) -> str:
    codes = tokens.key_role[0, span.start : span.stop]
    roles = ", ".join(f"{Role(code).label} {int((codes == code).sum())}" for code in sorted(set(codes.tolist())))
    grid = f"  {span.grid.describe()}" if span.grid else ""
    growing = "  growing: generated one after another" if span.growing else ""
    return f"{span.name:<18} {span.start:>4}..{span.stop - 1:<4} {roles}{grid}{growing}"


def protocol_text(protocol: Protocol) -> str:
    """The protocol on one line; of a loop that is not ours only what is known."""
    if not protocol.of_other_loop:
        return (
            f"{protocol.name}, seed {protocol.seed}, pictures of {protocol.image_size} pixels, {protocol.wait_steps} "
            f"waiting steps, a replan every {protocol.replan_steps} steps, at most {protocol.max_steps} steps"
        )
    loop = "a replayed data set" if protocol.name == "dataset" else "the caller's own loop"
    known = {
        "picture size": (protocol.image_size, f"pictures of {protocol.image_size} pixels"),
        "replan steps": (protocol.replan_steps, f"a replan every {protocol.replan_steps} steps"),
        "most steps": (protocol.max_steps, f"at most {protocol.max_steps} steps"),
    }
    stated = [text for number, text in known.values() if number]
    missing = [name for name, (number, _) in known.items() if not number]
    parts = ", ".join([f"{protocol.name} ({loop})", f"seed {protocol.seed}", *stated])
    return parts + (f"; not known: {listing(missing)}" if missing else "")


def own_parts(root: RootAttributes, site: str) -> str:
    """What is recorded of a site that has layers, heads or action queries of its own."""
    recording = root.recording_of(site)
    return (
        f"layers {listing(recording.layers, 40)}; {plural(len(recording.heads), 'head')}; "
        f"{recording.num_action_queries} action queries"
    )
