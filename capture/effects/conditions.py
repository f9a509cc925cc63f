"""Which conditions the effects of an episode are measured under: each is what one rerun would change."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from msgspec.structs import replace

from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.effects.patch_maps import check_map
from vla_attention.capture.interventions.condition_name import condition_name, knockout_of_group, plain
from vla_attention.capture.interventions.prompts import with_synonyms
from vla_attention.capture.interventions.resolution import run_vocabularies
from vla_attention.capture.policies.policy import Policy, PolicyInput, UnitsPolicy, VariantPolicy
from vla_attention.schemas.effects import EffectItem, EffectItemKind, EffectItems, EffectReaders, EffectsRecorded
from vla_attention.schemas.errors import BadArgument, UserError, listing, plural
from vla_attention.schemas.groupings.builtin_groupings import TEXT_KEYS, find_grouping
from vla_attention.schemas.groupings.grouping import REST
from vla_attention.schemas.groupings.selector_weights import selector_weights
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject, Vocabulary
from vla_attention.schemas.groupings.words import Word, folded_words, words_of
from vla_attention.schemas.interventions import (
    ImageChange,
    Interventions,
    KeyKnockout,
    NoiseChange,
    PromptChange,
    Queries,
)
from vla_attention.schemas.layout import SiteLayout

#: Whose attention a reader is, as of `KeyKnockout`.
_READERS: dict[EffectReaders, tuple[Queries, str]] = {
    "all": ("all", ""),
    "action": ("action", ""),
    "pictures": ("prefix", "role:image"),
    "text": ("prefix", "role:bos | role:template | role:instruction | role:state"),
}
#: The parts of a prompt.
_PARTS = ("bos", "template", "instruction", "state")
#: The call made again among the changed ones, without a change.
UNCHANGED = Interventions("unchanged")


def check_effects(planned: EffectsRecorded, policy: Policy) -> None:
    """Raise `BadArgument` if the policy has no effects that can be measured like this."""
    if not isinstance(policy, UnitsPolicy):
        raise BadArgument(f"Cannot measure effects of {policy.family}: it does not say what a unit of its actions is.")
    if planned.denoise_steps < policy.num_denoise_steps and not isinstance(policy, VariantPolicy):
        raise BadArgument(f"Cannot use --effects-steps with {policy.family}, whose calls are made again one by one.")
    if planned.denoise_steps > policy.num_denoise_steps:
        raise BadArgument(
            f"Cannot use --effects-steps {planned.denoise_steps}; {policy.name} has {policy.num_denoise_steps} denoise "
            "steps."
        )
    check_map(planned, policy)
    for reader in planned.readers:
        if _READERS[reader][0] == "prefix" and not policy.has_prefix:
            raise BadArgument(
                f"Cannot measure effects by the reader '{reader}': {policy.name} has no prefix, in which pictures and "
                "prompt read each other before the denoise steps; use --effects-readers all action."
            )


def planned_effects(settings: EffectSettings | None, policy: Policy, seed: int) -> EffectsRecorded | None:
    """Return which effects a run measures; seed: of its noise. Raises `BadArgument` for what the policy has not."""
    if settings is None:
        return None
    steps = policy.num_denoise_steps if settings.denoise_steps is None else settings.denoise_steps
    other = seed + 1 if seed + 1 < 2**63 else seed - 1
    planned = effects_recorded(settings, policy.sites, steps, other)
    check_effects(planned, policy)
    return planned


def effects_recorded(
    settings: EffectSettings, sites: Sequence[SiteLayout], denoise_steps: int, seed: int
) -> EffectsRecorded:
    """Return the effects of settings at these sites, with the selectors of the grouping's groups."""
    kinds = {word.partition(":")[0] for word in settings.items}
    items: list[EffectItems] = [item for item in get_args(EffectItems) if item in kinds]
    groups = {} if settings.grouping is None else _groups_of(settings.grouping, sites)
    items += ["groups"] if groups else []
    if settings.prompts and not settings.rows:
        raise BadArgument(f"Cannot use --prompts {settings.prompts} here, where no task is known yet; use a rerun.")
    items += ["prompts"] if settings.rows else []
    return EffectsRecorded(
        tuple(items), settings.readers, settings.every, denoise_steps, seed, groups, settings.rows, settings.blocks,
        settings.controls,
    )  # fmt: skip


def describe_effects(planned: EffectsRecorded) -> str:
    """Return the line that is printed before a run."""
    named = {"groups": plural(len(planned.groups), "group"), "prompts": plural(planned.most_prompts, "other prompt")}
    items = [named.get(item, item) for item in planned.items if item != "map"]
    readers = {"all": "for all queries", "action": "for the action queries", "pictures": "by the pictures"}
    by = listing((readers | {"text": "by the prompt"})[reader] for reader in planned.readers)
    often = "every replan" if planned.every == 1 else f"one replan in {planned.every}"
    of_map = "patches, for all queries" if planned.blocks is None else "blocks of the pictures"
    parts = [f"{listing(items)}, {by}"] * bool(items) + [of_map] * ("map" in planned.items)
    return f"Effects of {'; of '.join(parts)}; at {often} (docs/effects.md)."


def refuse_both(interventions: Interventions) -> None:
    """Raise `BadArgument` if a run that measures effects changes attention by itself."""
    if interventions.changes_attention:
        raise BadArgument(
            "Cannot measure effects beside interventions on attention: a call would have both. Leave out --effects, or "
            "the interventions; changes of prompt, pictures and noise go together with effects."
        )


def conditions_of(
    planned: EffectsRecorded,
    policy: Policy,
    policy_input: PolicyInput,
    tokens: Mapping[str, EpisodeTokens],
    vocabularies: Mapping[str, Vocabulary],
    objects: Sequence[SceneObject],
    siblings: Sequence[str],
    task_id: int,
    with_mean: Collection[str] = (),
) -> tuple[tuple[Interventions, EffectItem], ...]:
    """Return the conditions of an episode, from its first call: the unchanged call, other noise, then every item.

    tokens, vocabularies: by site. objects: of the scene. siblings: the instructions of the other tasks of the task's
    family. task_id: of the rows of a prompt table. with_mean: the cameras of which a mean picture is known; the others
    become grey.
    """
    words = words_of(policy_input.prompt)
    groups: dict[str, _Group] = {}
    for group in _groups(planned, policy, tokens, vocabularies, objects, words):
        # A group of a grouping may be one of the other items: it is measured once.
        known = groups.setdefault(group.selector, group)
        groups[group.selector] = dataclasses.replace(known, alone=known.alone or group.alone)
    controlled = _controlled(planned, words) if planned.controls else []
    # Calls that are made one by one are the same to the bit: only a batch needs the unchanged one among them.
    conditions = [(UNCHANGED, EffectItem("nothing"))] if isinstance(policy, VariantPolicy) else []
    conditions.append((Interventions("noise", noise=NoiseChange(planned.seed)), EffectItem("noise")))
    for reader in planned.readers:
        queries, query_selector = _READERS[reader]
        for selector, group in groups.items():
            knockout = KeyKnockout(selector, queries=queries, query_selector=query_selector)
            item = EffectItem("without", group.kind, group.item, reader=reader)
            conditions.append((knockout_of_group("without", group.name, knockout), item))
            if group.alone and planned.controls and queries != "prefix":
                alone = knockout_of_group("only", group.name, replace(knockout, keep=True))
                conditions.append((alone, replace(item, change="only")))
        for selector in controlled:
            random = KeyKnockout(selector, queries=queries, query_selector=query_selector, random_seed=planned.seed)
            item = EffectItem("random", groups[selector].kind, groups[selector].item, reader=reader)
            conditions.append((knockout_of_group("random", groups[selector].name, random), item))
    instruction, rows = policy_input.prompt.instruction_text, [row for row in planned.prompts if row.task_id == task_id]
    changes = [row.change for row in rows]
    if "text" in planned.items:
        told = {folded_words(row.sentence) for row in rows}
        exchanged = exchanges(instruction, siblings)
        changes += [one for one in exchanged if folded_words(with_synonyms(instruction, one.synonyms)) not in told]
    conditions += [(_named(Interventions(prompt=change)), _exchanged(change)) for change in changes]
    if "cameras" in planned.items:
        for camera in policy_input.frames:
            change = ImageChange(camera, "mean" if camera in with_mean else "blank")
            item = EffectItem("image", "camera", camera, change.kind)
            conditions.append((_named(Interventions(images=(change,))), item))
    return tuple(conditions)


def _exchanged(change: PromptChange) -> EffectItem:
    """Return what a prompt exchanges: a word for another, or the sentence."""
    for word, other in change.synonyms.items():
        return EffectItem("prompt", "exchange", word, other)
    return EffectItem("prompt", change.meaning, instead=change.text)


def _named(interventions: Interventions) -> Interventions:
    return replace(interventions, name=condition_name(interventions))


@dataclass(frozen=True)
class _Group:
    """Keys that are cut off: how the condition and the item are called. alone: everything but them is cut off, too."""

    name: str
    selector: str
    kind: EffectItemKind
    item: str = ""
    alone: bool = False


def _groups(
    planned: EffectsRecorded,
    policy: Policy,
    tokens: Mapping[str, EpisodeTokens],
    vocabularies: Mapping[str, Vocabulary],
    objects: Sequence[SceneObject],
    words: Sequence[Word],
) -> Iterator[_Group]:
    def has_keys(selector: str) -> bool:
        weights = selector_weights(selector, tokens, vocabularies)
        return any((group[0] * tokens[site].valid[0]).any() for site, group in weights.items())

    if "text" in planned.items:
        yield _Group("linguistic", TEXT_KEYS, "text", alone=True)
        yield from (_Group(part, f"role:{part}", "part", part) for part in _PARTS if has_keys(f"role:{part}"))
        yield from (_Group(f"word_{text}", _of_word(text), "word", text) for text in dict.fromkeys(_texts(words)))
    if "tokens" in planned.items:
        of_words = {key for word in words for key in word.keys}
        for site, of_site in tokens.items():
            if of_site.prompts:
                prompt_keys = [piece.key for piece in of_site.prompts[0].pieces if piece.key not in of_words]
                # Another site has keys of the same numbers, which are others.
                within = "" if len(tokens) == 1 else f"{_text_spans(of_site)} & "
                for key in prompt_keys:
                    name = f"{key} of {site}" if within else f"{key}"
                    yield _Group(f"{site}_key_{key}", f"{within}keys:{key}-{key}", "token", name)
    if "cameras" in planned.items:
        yield _Group("visual", "role:image", "pictures", alone=True)
        for camera in policy.cameras:
            yield _Group(f"camera_{camera.name}", f"camera:{camera.name}", "camera", camera.name)
    if "objects" in planned.items:
        yield from (_Group(f"object_{thing.name}", f'object:"{thing.name}"', "object", thing.name) for thing in objects)
    for name, selector in planned.groups.items():
        yield _Group(f"group_{plain(name)}", selector, "group", name, alone=True)


def _groups_of(grouping: str, sites: Sequence[SiteLayout]) -> dict[str, str]:
    """Return the selector of each group of a grouping, at all sites that it fits, without the group of the rest."""
    groups: dict[str, str] = {}
    problems: list[UserError] = []
    for vocabulary in run_vocabularies(sites, (), ()).values():
        try:
            known = find_grouping(grouping, vocabulary)
        except UserError as error:
            problems.append(error)
            continue
        for name, selectors in known.groups.items():
            if not any(selector.strip() == REST for selector in selectors):
                joined = " | ".join(f"({selector})" for selector in selectors) if len(selectors) > 1 else selectors[0]
                groups.setdefault(name, joined)
    if not groups:
        raise problems[0] if problems else BadArgument(f"The grouping '{grouping}' has no group but that of the rest.")
    return groups


def _text_spans(tokens: EpisodeTokens) -> str:
    names = [f"span:{span.name}" for span in tokens.layout.spans if span.kind == "text"]
    return names[0] if len(names) == 1 else f"({' | '.join(names)})"


def _texts(words: Sequence[Word]) -> list[str]:
    return [word.text.casefold() for word in words]


def _of_word(text: str) -> str:
    return f'word:"{text}"'


def _controlled(planned: EffectsRecorded, words: Sequence[Word]) -> list[str]:
    """The selectors that random keys are drawn for: the word with the most keys, the instruction, every group."""
    counts: dict[str, int] = {}
    for word in words if "text" in planned.items else ():
        text = word.text.casefold()
        counts[text] = counts.get(text, 0) + len(word.keys)
    of_text = [_of_word(max(counts, key=lambda text: counts[text])), "role:instruction"] if counts else []
    return list(dict.fromkeys([*of_text, *planned.groups.values()]))


def exchanges(instruction: str, siblings: Sequence[str]) -> list[PromptChange]:
    """Return the exchange of each word for every other word that stands in its place in a sibling's instruction.

    Siblings with another number of words have no such places.
    """
    mine = folded_words(instruction)
    changes: dict[tuple[str, str], PromptChange] = {}
    for sibling in siblings:
        theirs = folded_words(sibling)
        if len(theirs) == len(mine):
            for word, other in zip(mine, theirs, strict=True):
                if word != other:
                    changes.setdefault((word, other), PromptChange("synonyms", synonyms={word: other}))
    return [changes[pair] for pair in sorted(changes)]
