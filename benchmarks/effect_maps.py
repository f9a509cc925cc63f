"""Which patches move the action: cheap maps against exact knock-outs of every single patch.

Usage: python benchmarks/effect_maps.py STORE [--tasks 12] [--calls 2] [--draws 30] [--threads 1]

STORE: what `make capture` writes, of `pi05_cubes`. Of each task the first policy calls of its first episode are made
again. The exact map hides one patch at a time from all tokens; its size is the root mean square change of the executed
actions, normalised. Correlations are Spearman's, over the patches of a call; numbers are means over the calls, with
intervals over tasks (t). `benchmarks/README.md` explains the columns.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from measurement import Table, fix_threads, measured, write_rows

#: Patches of a map that are its top tenth, and those that are knocked out exactly in the combination.
TOP, EXACT, RANDOM = 0.1, 0.15, 10


def main() -> None:
    """Measure, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("--tasks", type=int, default=12)
    parser.add_argument("--calls", type=int, default=2)
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    fix_threads(arguments.threads)
    calls = list(measured_calls(arguments.store, arguments.tasks, arguments.calls))
    write_rows("effect_maps", {"maps": map_table(calls, arguments.draws)})


@dataclass(frozen=True)
class Call:
    """The maps of one call, over the patches of all cameras, and what they took in calls.

    Attributes:
        task: its number.
        exact, other: of every single patch, with the call's own noise and with another seed's.
        blocks: of blocks of four patches, the block's size in each of its patches.
        filled: of every patch's part of the picture, filled from its surroundings.
        attention: of the action queries.
        columns: the Jacobian by patch (output, patch), of a small weight and of whole patches.
        named, robot: the part of each patch that what the sentence names covers, and the robot.
        cost: seconds of a map / those of the call.
    """

    task: int
    exact: Any
    other: Any
    blocks: Any
    filled: Any
    attention: Any
    columns: Mapping[bool, Any]
    named: Any
    robot: Any
    cost: Mapping[str, float]


class Maker:
    """Makes calls of a policy again without patches, and takes their gradients."""

    def __init__(self, policy: Any, steps: int) -> None:
        import numpy as np

        self.policy, self.model, self.site, self.steps = policy, policy.model, policy.sites[0], steps
        self.grids = [(camera.name, self.site.patch_keys(camera.name)) for camera in policy.cameras]
        self.patches = np.concatenate([keys for _, keys in self.grids])
        used, config = np.flatnonzero(policy.action_units()), self.model.config
        self.directions = np.zeros((steps * len(used), config.action_horizon, config.action_dim), np.float32)
        for i, (step, dimension) in enumerate(np.ndindex(steps, len(used))):
            self.directions[i, step, used[dimension]] = 1.0

    @property
    def single(self) -> list[Any]:
        """Every patch."""
        return list(self.patches[:, None])

    @property
    def blocks(self) -> list[Any]:
        """Blocks of four patches."""
        found = []
        for _, keys in self.grids:
            side = round(len(keys) ** 0.5)
            square = keys.reshape(side, side)
            found += [square[i : i + 2, j : j + 2].ravel() for i in range(0, side, 2) for j in range(0, side, 2)]
        return found

    def sizes(self, given: Any, seed: int, groups: list[Any]) -> Any:
        """Root mean square change of the executed actions, normalised, without each group of keys."""
        from single_patches import sizes, without

        from vla_attention.capture.policies.policy import CallVariant

        variants = [without(self.policy, given, seed, keys) for keys in groups]
        return sizes(self.policy, CallVariant(given, seed), variants, self.steps)

    def filled(self, given: Any, seed: int) -> Any:
        """The same with every patch's part of the picture filled from its surroundings."""
        from single_patches import sizes

        from vla_attention.capture.effects.patch_maps import CallMap, picture_blocks
        from vla_attention.capture.policies.policy import CallVariant
        from vla_attention.schemas.effects import MapBlocks

        (side,) = {round(len(keys) ** 0.5) for _, keys in self.grids}
        planned = MapBlocks("picture", side, side)
        blocks = picture_blocks(self.policy, planned)
        made = CallMap(blocks, planned, dict.fromkeys(range(len(blocks)), False), None, self.steps, "all")
        variants = made.variants(self.policy, given, seed)
        return sizes(self.policy, CallVariant(given, seed), [variants[i] for i in range(len(blocks))], self.steps)

    def gradients(self, given: Any, seed: int, whole: bool, count: int | None = None) -> Any:
        """Columns of the Jacobian by patch (output, patch), of all outputs or the first."""
        import torch

        from vla_attention.capture.policies.pi.influence import cut_gradients

        directions, noise = torch.from_numpy(self.directions[:count]), self.policy._noise([seed])
        steps = self.model.config.num_denoise_steps
        return cut_gradients(self.model, given.tensors, noise, directions, steps, whole)[:, self.patches].numpy()


def measured_calls(place: str, tasks: int, number: int) -> Iterator[Call]:
    """The first calls of the first episode of so many tasks, evenly over all."""
    import numpy as np
    import torch

    from vla_attention.analyze.view.episode_answers import MEAN, ShownEpisode
    from vla_attention.capture.engine.call import Caller
    from vla_attention.capture.interventions.run_changes import RunChanges
    from vla_attention.capture.policies.families import default_family
    from vla_attention.capture.rerun.stored_calls import read_calls
    from vla_attention.schemas.interventions import Interventions
    from vla_attention.schemas.stores.reader import open_store

    torch.set_num_threads(1)
    policy, store = default_family().settings().build("cpu"), open_store(place)
    firsts = {one.attributes.task_id: one for one in reversed(store.episodes)}
    chosen = [sorted(firsts)[i] for i in np.linspace(0, len(firsts) - 1, tasks).round().astype(int)]
    told = {task: one.attributes.instruction for task, one in firsts.items()}
    caller = Caller(policy, store.attributes.recording, RunChanges(Interventions(), told))
    maker = Maker(policy, store.attributes.protocol.replan_steps)
    for task, replan in ((task, replan) for task in chosen for replan in range(number)):
        episode = firsts[task]
        shown, call = ShownEpisode(store, episode), read_calls(episode).again(caller, replan)
        names = [thing.name for thing in episode.attributes.objects]
        cover = np.concatenate([episode.read(f"objects/{camera}")[replan] for camera, _ in maker.grids])
        given, seed = call.policy_input, call.noise_seed
        by_block = maker.sizes(given, seed, maker.blocks)
        of_patch = {key: size for keys, size in zip(maker.blocks, by_block, strict=True) for key in keys}
        rows = shown.rows(maker.site.name, MEAN)[replan].mean(axis=0)
        yield Call(
            task,
            maker.sizes(given, seed, maker.single),
            maker.sizes(given, seed + 1, maker.single),
            np.array([of_patch[key] for key in maker.patches]),
            maker.filled(given, seed),
            rows[maker.patches],
            {whole: maker.gradients(given, seed, whole) for whole in (False, True)},
            cover[:, [i for i, name in enumerate(names) if name in shown.named]].sum(axis=1),
            cover[:, names.index("robot")],
            costs(maker, given, seed),
        )
        print(f"task {task}, call {replan}", flush=True)


def costs(maker: Maker, given: Any, seed: int) -> dict[str, float]:
    """Seconds of the processor for each map / those of the call."""
    few = maker.single[: round(EXACT * len(maker.patches)) + RANDOM]
    plain = _seconds(lambda: maker.policy.act(given, seed))
    calls: dict[str, Callable[[], object]] = {
        "exact": lambda: maker.sizes(given, seed, maker.single),
        "blocks": lambda: maker.sizes(given, seed, maker.blocks),
        "filled": lambda: maker.filled(given, seed),
        "few": lambda: maker.sizes(given, seed, few),
        "16": lambda: maker.gradients(given, seed, True, 16),
        "8": lambda: maker.gradients(given, seed, True, 8),
        "4": lambda: maker.gradients(given, seed, True, 4),
    }
    return {name: _seconds(one) / plain for name, one in calls.items()}


def _seconds(call: Callable[[], object]) -> float:
    call()
    began = time.process_time()
    call()
    return time.process_time() - began


def map_table(calls: list[Call], draws: int) -> Table:
    """A row for each map."""
    import numpy as np
    from scipy.stats import spearmanr, t

    number = len(calls[0].exact)
    top, exact = round(TOP * number), round(EXACT * number)

    def interval(values: list[float], digits: int = 2) -> str:
        """The mean over calls, with the interval of the mean over tasks."""
        tasks = np.array([np.mean([v for v, c in zip(values, calls, strict=True) if c.task == task])
                          for task in sorted({call.task for call in calls})])  # fmt: skip
        half = t.ppf(0.975, len(tasks) - 1) * tasks.std(ddof=1) / len(tasks) ** 0.5
        return f"{tasks.mean():.{digits}f} [{tasks.mean() - half:.{digits}f}, {tasks.mean() + half:.{digits}f}]"

    def nuisance(order: Any, sizes: Any, call: Call) -> float:
        """Of the top tenth by `order`, the part of `sizes` on neither what the sentence names nor the robot."""
        chosen = np.argsort(-order)[:top]
        other = np.clip(1.0 - call.named - call.robot, 0.0, 1.0)
        return float((sizes * other)[chosen].sum() / sizes[chosen].sum())

    def row(name: str, cost: str, maps: Callable[[Call, Any], Any], repeats: int = 1) -> dict[str, Any]:
        generator, rank, ten, part, contrast = np.random.default_rng(0), [], [], [], []
        for call in calls:
            of_call = [maps(call, generator) for _ in range(repeats)]
            strongest = np.argsort(-call.exact)[:10]
            rank.append(np.mean([spearmanr(one, call.exact).statistic for one in of_call]))
            ten.append(np.mean([np.isin(strongest, np.argsort(-one)[:exact]).mean() for one in of_call]))
            part.append(np.mean([nuisance(one, one, call) - nuisance(call.exact, call.exact, call) for one in of_call]))
            named = call.named >= 0.5
            if named.any():
                contrast.append(np.mean([one[named].mean() / one[~named].mean() for one in of_call]))
        took = "-" if not cost else measured([call.cost[cost] for call in calls])
        return {
            "map": name,
            "calls": took,
            "rank": interval(rank),
            "ten": f"{100 * np.mean(ten):.0f} %",
            "nuisance": interval(part),
            "named": f"{np.median(contrast):.1f}",
        }

    def projected(whole: bool, count: int) -> Callable[[Call, Any], Any]:
        def of(call: Call, generator: Any) -> Any:
            columns = call.columns[whole]
            signs = generator.choice([-1.0, 1.0], (count, len(columns)))
            return np.sqrt(((signs @ columns) ** 2).mean(axis=0))

        return of

    def jacobian(whole: bool) -> Callable[[Call, Any], Any]:
        return lambda call, _: np.sqrt((call.columns[whole] ** 2).mean(axis=0))

    rows = [
        row("exact, one patch at a time", "exact", lambda call, _: call.exact),
        row("the same with another noise seed", "", lambda call, _: call.other),
        row("exact, blocks of four patches", "blocks", lambda call, _: call.blocks),
        row("each patch filled from its surroundings in the picture", "filled", lambda call, _: call.filled),
        row("attention of the action queries", "", lambda call, _: call.attention),
    ]
    for whole, form in ((False, "a small weight"), (True, "whole patches")):
        rows.append(row(f"first order of {form}: all outputs", "", jacobian(whole)))
        rows += [
            row(
                f"first order of {form}: {count} projections",
                f"{count}" if whole else "",
                projected(whole, count),
                draws,
            )
            for count in (16, 8, 4)
        ]
    sizes = {
        whole: np.concatenate([np.sqrt((c.columns[whole] ** 2).mean(axis=0)) for c in calls]) for whole in (False, True)
    }
    all_exact = np.concatenate([call.exact for call in calls])
    large = all_exact >= np.quantile(all_exact, 0.99)
    found = ", ".join(
        f"{'whole patches' if whole else 'a small weight'} {np.median(sizes[whole][large] / all_exact[large]):.2f}"
        for whole in (False, True)
    )
    few = measured([call.cost["few"] for call in calls])
    note = (
        f"{len(calls)} calls of {len({call.task for call in calls})} tasks, {number} patches; {draws} draws of the "
        f"projections. First order / exact of the strongest hundredth of patches, median: {found}. Exact knock-outs of "
        f"{exact} + {RANDOM} patches take {few.median:.1f} calls."
    )  # fmt: skip
    columns = {
        "map": "map",
        "calls": "policy calls",
        "rank": "rank correlation with exact",
        "ten": f"exact ten best among its best {exact}",
        "nuisance": "part of its top tenth on other things, minus the exact one's",
        "named": "named / other patches",
    }
    return Table(columns, rows, note)


if __name__ == "__main__":
    main()
