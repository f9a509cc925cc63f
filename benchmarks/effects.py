"""What effects cost: the calls that are made again at a replan, in policy calls, and what they take on disk.

Usage: python benchmarks/effects.py [--rounds 7] [--calls 4] [--threads 1] [--full-size] [--device cpu]

Stored calls of the example store of `pi05_cubes`, one of each of its episodes, are made as they are and with effects,
taking turns; a number is a median over rounds of the seconds divided by those of the plain calls of the same round.
`rank`: Spearman's correlation of the words' and parts' effects with those of all denoise steps, over all calls.
`--full-size`: instead, one call of a pi0.5 of full size in bfloat16 (978 keys, random weights), with its memory.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import time

from measurement import Table, fix_threads, measured, peak_memory, ratios, write_rows

#: Name of a row -> items, readers, denoise steps (None: all), and the conditions that are kept (None: all).
KINDS: dict[str, tuple[tuple[str, ...], tuple[str, ...], int | None, int | None]] = {
    "1 item, nobody reads it": (("text",), ("all",), None, 1),
    "5 items": (("text",), ("all",), None, 5),
    "14 items": (("text", "cameras"), ("all",), None, 14),
    "text,cameras": (("text", "cameras"), ("all", "action"), None, None),
    "text,cameras, no exchanges": (("text", "cameras"), ("all", "action"), None, -1),
    "text,cameras, all four readers": (("text", "cameras"), ("all", "action", "pictures", "text"), None, None),
    "text,cameras, 5 of 10 denoise steps": (("text", "cameras"), ("all", "action"), 5, None),
    "text,cameras, 2 of 10 denoise steps": (("text", "cameras"), ("all", "action"), 2, None),
}


def main() -> None:
    """Measure, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--calls", type=int, default=4)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--full-size", action="store_true")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    fix_threads(arguments.threads)
    if arguments.full_size:
        write_rows("effects", {"full_size": full_size_table(arguments.device, arguments.threads)})
        return
    write_rows("effects", {"cost": cost_table(arguments.rounds, arguments.calls, arguments.threads)})


def cost_table(rounds: int, number: int, threads: int) -> Table:
    """A row for each of `KINDS`."""
    import numpy as np
    import torch
    from scipy.stats import spearmanr

    import vla_attention as va
    from vla_attention.capture.effects.arguments import EffectSettings
    from vla_attention.capture.effects.conditions import UNCHANGED, planned_effects
    from vla_attention.capture.effects.measurement import EffectMeasurement, siblings_of
    from vla_attention.capture.engine.call import Caller
    from vla_attention.capture.interventions.run_changes import RunChanges
    from vla_attention.capture.policies.families import default_family
    from vla_attention.capture.rerun.stored_calls import read_calls
    from vla_attention.schemas.interventions import Interventions
    from vla_attention.schemas.stores.reader import open_store

    torch.set_num_threads(threads)
    family = default_family()
    policy = family.settings().build("cpu")
    store = open_store(va.example("cubes"))
    tasks = {episode.attributes.task_id: episode.attributes for episode in store.episodes}
    instructions = {number: task.instruction for number, task in tasks.items()}
    families = siblings_of((number, task.instruction, task.task_family) for number, task in tasks.items())
    caller = Caller(policy, store.attributes.recording, RunChanges(Interventions(), instructions))
    calls = []
    for episode in store.episodes[:number]:
        stored = read_calls(episode)
        call = stored.again(caller, 1)
        given, seed = call.policy_input, call.noise_seed
        calls.append((given, seed, policy.act(given, seed), call.context))

    def measure(kind: str):
        items, readers, steps, kept = KINDS[kind]
        planned = planned_effects(EffectSettings(items, readers, 1, steps), policy, 7)
        run = EffectMeasurement(policy, planned, families, lambda line: None)
        for given, seed, actions, context in calls:
            episode = run.begin()
            if kept is not None:
                whole = run.begin()
                whole.measure(given, seed, actions, context)
                wanted = [one for one in whole.conditions or () if one.keys and one.keys[0].random_seed is None]
                plain = [one for one in whole.conditions or () if not one.changes_input]
                episode.conditions = tuple(plain) if kept < 0 else (UNCHANGED, *wanted[:kept])
            yield given, seed, actions, context, episode

    prepared = {kind: list(measure(kind)) for kind in KINDS}
    seconds: dict[str, list[float]] = {kind: [] for kind in ("plain", *KINDS)}
    results = {}
    for _ in range(rounds):
        began = time.perf_counter()
        for given, seed, _, _ in calls:
            policy.act(given, seed)
        seconds["plain"].append(time.perf_counter() - began)
        for kind, members in prepared.items():
            began = time.perf_counter()
            results[kind] = [
                episode.measure(given, seed, actions, context) for given, seed, actions, context, episode in members
            ]
            seconds[kind].append(time.perf_counter() - began)

    def norms(kind: str) -> dict[tuple[int, str], float]:
        return {
            (call, effects.conditions[number].name): float(np.sqrt((change[:5] ** 2).mean()))
            for call, effects in enumerate(results[kind])
            for number, change in zip(effects.measured, effects.change, strict=True)
            if effects.conditions[number].keys
        }

    whole, rows = norms("text,cameras"), []
    for kind in KINDS:
        own = norms(kind)
        both = [name for name in whole if name in own]
        rank = spearmanr([whole[name] for name in both], [own[name] for name in both])[0] if len(both) > 2 else None
        rows.append(
            {
                "what": kind,
                "conditions": round(float(np.mean([len(effects.measured) for effects in results[kind]]))),
                "calls": measured(ratios(seconds[kind], seconds["plain"])),
                "rank": "-" if "denoise" not in kind or rank is None else f"{rank:.3f}",
            }
        )
    columns = {"what": "effects", "conditions": "conditions", "calls": "policy calls", "rank": "rank correlation"}
    return Table(columns, rows)


def full_size_table(device: str, threads: int, policy=None) -> Table:
    """One call as it is, and with effects of some numbers of items: seconds, policy calls, and the most memory.

    policy: one of full size unless given.
    """
    import numpy as np
    import torch
    from capture_overhead import make_policy, prepared_input

    from vla_attention.capture.effects.arguments import EffectSettings
    from vla_attention.capture.effects.conditions import UNCHANGED, planned_effects
    from vla_attention.capture.effects.measurement import EffectMeasurement
    from vla_attention.capture.interventions.changed_inputs import CallContext

    torch.set_num_threads(threads)
    policy = policy or make_policy("full", device, "bfloat16")
    forget_peak(device)
    model = largest_memory(device)
    given, context = prepared_input(policy), CallContext(0, 0, 0)
    planned = planned_effects(EffectSettings(("text", "cameras")), policy, 7)
    run = EffectMeasurement(policy, planned, {}, print)
    began = time.perf_counter()
    actions = policy.act(given, 7)
    print(f"first call: {time.perf_counter() - began:.1f} s", flush=True)

    def timed(call):
        forget_peak(device)
        began = time.perf_counter()
        result = call()
        return result, time.perf_counter() - began, round((largest_memory(device) - model) / 1e9, 2)

    _, plain, memory = timed(lambda: policy.act(given, 7))
    rows = [{"what": "the call alone", "conditions": 0, "seconds": plain, "calls": 1.0, "gb": memory, "floor": "-"}]
    whole = run.begin()
    made, run.actions_of = run.actions_of, lambda variants: {}  # the conditions alone
    whole.measure(given, 7, actions, context)
    run.actions_of = made
    kept = [one for one in whole.conditions or () if one.keys and one.keys[0].random_seed is None]
    wanted = {"1 item, nobody reads it": 1, "5 items": 5, "14 items": 14, "text,cameras": None}
    for what, number in wanted.items():
        episode = run.begin()
        episode.conditions = whole.conditions if number is None else (UNCHANGED, *kept[:number])
        effects, seconds, memory = timed(lambda episode=episode: episode.measure(given, 7, actions, context))
        row = {"what": what, "conditions": len(effects.measured), "seconds": seconds, "calls": seconds / plain}
        rows.append(row | {"gb": memory, "floor": f"{float(np.abs(effects.change[0]).max()):.2g}"})
        print(rows[-1], flush=True)
    columns = {
        "what": "effects",
        "conditions": "conditions",
        "seconds": "seconds",
        "calls": "policy calls",
        "gb": "memory beyond the model's, GB",
        "floor": "largest difference of the unchanged call",
    }
    return Table(columns, rows)


def forget_peak(device: str) -> None:
    """Let the largest memory begin anew."""
    import torch

    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
        return
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what calls before gave back
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def largest_memory(device: str) -> float:
    """Return the largest memory since `forget_peak`, in bytes."""
    import torch

    return float(torch.cuda.max_memory_allocated()) if device != "cpu" else peak_memory()


if __name__ == "__main__":
    main()
