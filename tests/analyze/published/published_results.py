"""Results files as the published scripts write them, made up here: pi's and Cosmos's structures, number by number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

#: Below this the published scripts call a mass nothing.
NOTHING = 1e-8


def published_ratio(visual: float, linguistic: float) -> float:
    if linguistic > NOTHING:
        return visual / linguistic
    return float("inf") if visual > NOTHING else 0.0


def pi_step(step: int, visual: float, linguistic: float, action: float) -> dict[str, Any]:
    total = max(visual + linguistic + action, NOTHING)
    return {
        "step": step,
        "visual_linguistic_ratio": published_ratio(visual, linguistic),
        "visual_mass": visual,
        "linguistic_mass": linguistic,
        "action_mass": action,
        "visual_fraction": visual / total,
        "linguistic_fraction": linguistic / total,
        "action_fraction": action / total,
    }


def cosmos_step(step: int, visual: float, linguistic: float) -> dict[str, Any]:
    total = max(visual + linguistic, NOTHING)
    return {
        "step": step,
        "visual_linguistic_ratio": published_ratio(visual, linguistic),
        "visual_mass": visual,
        "linguistic_mass": linguistic,
        "visual_fraction": visual / total,
        "linguistic_fraction": linguistic / total,
        "selected_call_S": 1800,
        "query_frame": "action",
        "visual_frame": "curr_last",
        "text_frame": "frame0",
    }


def published_average(layers: list[dict[str, Any]]) -> dict[str, Any]:
    """One step of "layers_avg": masses are means, the ratio is the mean of the finite ones, 0 when there is none."""
    visual, linguistic, action = (
        float(np.mean([layer[f"{side}_mass"] for layer in layers])) for side in ("visual", "linguistic", "action")
    )
    step = pi_step(layers[0]["step"], visual, linguistic, action)
    finite = [x["visual_linguistic_ratio"] for x in layers if np.isfinite(x["visual_linguistic_ratio"])]
    step["visual_linguistic_ratio"] = float(np.mean(finite)) if finite else 0.0
    return step


def published_summary(steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Without action, without a count of infinities, and 0.0 where no ratio is finite."""
    ratios = np.array([step["visual_linguistic_ratio"] for step in steps])
    ratios = ratios[np.isfinite(ratios)]
    functions = {"mean": np.mean, "std": np.std, "median": np.median, "min": np.min, "max": np.max}
    summary: dict[str, Any] = {
        "visual_linguistic_ratio": {
            name: float(function(ratios)) if ratios.size else 0.0 for name, function in functions.items()
        }
    }
    for name in ("visual_mass", "linguistic_mass", "visual_fraction", "linguistic_fraction"):
        values = [step[name] for step in steps]
        summary[name] = {"mean": float(np.mean(values)), "std": float(np.std(values))}
    return {**summary, "num_steps": len(steps)}


def published_episode(task: int, index: int, layers: dict[str, list[dict[str, Any]]], **further: Any) -> dict[str, Any]:
    """The order of fields is that of the published scripts, which add identity after the rollout."""
    return {
        "success": (task + index) % 2 == 0,
        "num_steps": 60 + task,
        "summary": {name: published_summary(steps) for name, steps in layers.items() if steps},
        "task_id": task,
        "episode_idx": index,
        "task_description": ("put the bowl on the plate", "open the top drawer", "turn on the stove")[task % 3],
        **further,
        "per_step_ratios": layers,
    }


def pi_episodes(
    tasks: int = 3,
    episodes: int = 4,
    layers: tuple[int, ...] = (25, 26, 27),
    steps: int = 8,
    seed: int = 0,
    dark: float = 0.0,
) -> list[dict[str, Any]]:
    """`dark`: share of (step, layer) pairs in which nothing is read, so that the ratio is infinite."""
    generator = np.random.default_rng(seed)
    found = []
    for task in range(tasks):
        lean = generator.normal(1.0, 0.4)
        for index in range(episodes):
            by_layer: dict[str, list[dict[str, Any]]] = {f"layer_{layer}": [] for layer in layers}
            for step in range(steps):
                for layer in layers:
                    logits = generator.normal([lean + 0.2 * (layer % 5), 0.0, -1.0], 0.3)
                    visual, linguistic, action = np.exp(logits) / np.exp(logits).sum()
                    if generator.random() < dark:
                        visual, linguistic = visual + linguistic, 0.0
                    by_layer[f"layer_{layer}"].append(
                        pi_step(10 + 5 * step, float(visual), float(linguistic), float(action))
                    )
            if len(layers) > 1:
                by_layer["layers_avg"] = [published_average(list(at)) for at in zip(*by_layer.values(), strict=True)]
            found.append(
                published_episode(task, index, by_layer, visual_perturbation={"mode": "none", "rotation_degrees": 0.0})
            )
    return found


def cosmos_episodes(
    tasks: int = 2, episodes: int = 3, layers: tuple[int, ...] = (25, 26), steps: int = 5, seed: int = 0
) -> list[dict[str, Any]]:
    """Masses are sums over queries, and there is no "layers_avg"."""
    generator = np.random.default_rng(seed)
    return [
        published_episode(
            task,
            index,
            {
                f"layer_{layer}": [
                    cosmos_step(10 + 16 * step, *(float(mass) for mass in generator.uniform(2, 60, 2)))
                    for step in range(steps)
                ]
                for layer in layers
            },
        )
        for task in range(tasks)
        for index in range(episodes)
    ]


def write_published(folder: Path, suite: str, episodes: Any) -> Path:
    """As Python's json writes it by default: with Infinity and NaN, indented."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"attention_ratio_results_{suite}.json"
    path.write_text(json.dumps(episodes, indent=2), encoding="utf-8")
    return path
