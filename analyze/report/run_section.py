"""Where the numbers come from: stores, policy, protocol, recording, and what was asked."""

from __future__ import annotations

from vla_attention.analyze.ratios.analysis import Analysis, describe_heads
from vla_attention.analyze.report.section_parts import Definitions, Item, Part, Section
from vla_attention.analyze.show.numbers import format_percent, plural
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.stores.contents import own_parts, protocol_text
from vla_attention.schemas.errors import listing
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import PolicyCameraView

#: So many names of a list are shown, then "... more".
_MOST_LISTED = 40
_NOT_STATED = "not stated"


def run_section(analysis: Analysis) -> Section:
    """A list per store, each with its policy's configuration folded, then the question."""
    parts: list[Part] = []
    for store in analysis.question.stores:
        config = to_json(store.attributes.policy.config)
        parts.append(Definitions(_store_items(store)))
        parts.append(Definitions(_flat(config), summary="Configuration of the policy"))
    parts.append(Definitions(_question_items(analysis), heading="Selection and grouping"))
    return Section("run", "What was run, and what was asked", parts)


def _store_items(store: Store) -> list[Item]:
    root = store.attributes
    policy, protocol = root.policy, root.protocol
    untrained = ", untrained weights" if policy.untrained else ""
    libraries = [f"{name} {version}" for name, version in root.provenance.items() if name != "code"]
    return [
        Item("store", store.path, code=True),
        Item("episodes", len(store.episodes)),
        Item("suite", protocol.suite),
        Item("policy", f"{policy.name} (family {policy.family}){untrained}"),
        Item("checkpoint", f"{policy.checkpoint} ({policy.checkpoint_format})"),
        Item("digest of the weights", policy.digest, code=True),
        Item("computed in", policy.config.get("dtype", _NOT_STATED)),
        Item("code version at capture", root.provenance.get("code", _NOT_STATED)),
        Item("libraries and machine", ", ".join(libraries) or _NOT_STATED),
        Item("protocol", protocol_text(protocol)),
        *([] if root.data_set is None else [Item("data set", root.data_set.describe())]),
        Item("recording", _recording(store)),
        Item("cameras", "; ".join(map(_camera, policy.cameras)) or "none"),
    ]


def _recording(store: Store) -> str:
    recording = store.attributes.recording
    exact = recording.mantissa_bits >= FLOAT32_MANTISSA_BITS
    return "; ".join(
        [
            f"layers {listing(recording.layer_labels, _MOST_LISTED)}",
            f"denoise steps {listing(recording.denoise_steps, _MOST_LISTED)}",
            plural(len(recording.heads), "head"),
            f"queries: {recording.queries} of {recording.num_action_queries}",
            *(
                f"site {site.name}: {own_parts(store.attributes, site.name)}"
                for site in store.attributes.sites
                if site.layers or site.heads
            ),
            "rows exact" if exact else f"rows with {recording.mantissa_bits} bits",
            f"frames {'stored' if recording.frames else 'not stored'}",
            f"contributions {'recorded' if recording.contributions else 'not recorded'}",
        ]
    )


def _camera(view: PolicyCameraView) -> str:
    text = f"{view.name} from {view.source}"
    text += "" if view.upright else ", upside down"
    text += ", mirrored" if view.mirrored else ""
    return text if view.visible == 1 else f"{text}, middle {format_percent(view.visible, 0)} of its side"


def _flat(value: object, name: str = "") -> list[Item]:
    """Nested configuration as items with dotted names."""
    if isinstance(value, dict):
        return [item for key, part in value.items() for item in _flat(part, f"{name}.{key}" if name else str(key))]
    return [Item(name, value)]


def _question_items(analysis: Analysis) -> list[Item]:
    question, grouping = analysis.question, analysis.grouping
    selection, settings, ratio = question.selection, question.settings, grouping.ratio
    sides = () if ratio is None else (ratio.numerator, ratio.denominator)
    _, num_heads = question.stores[0].attributes.size_of(question.site)
    described = f": {grouping.description}" if grouping.description else ""
    return [
        Item("site", question.site),
        Item("layers", listing(selection.layer_labels, _MOST_LISTED)),
        Item("denoise steps", listing(selection.denoise_steps, _MOST_LISTED)),
        Item("heads", describe_heads(selection, num_heads)),
        Item("tasks", "all" if settings.tasks is None else listing(settings.tasks, _MOST_LISTED)),
        Item("grouping", f"{grouping.name}{described}"),
        *(Item(f"group {name}", " | ".join(parts), code=True) for name, parts in grouping.groups.items()),
        Item("ratio", " / ".join(" + ".join(side) for side in sides) or "none"),
        Item("intervals", f"{100 * DEFAULT_LEVEL:g}%, about {question.units.words}"),
    ]
