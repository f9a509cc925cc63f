"""The log of a training: log.csv, a line of progress, and a picture of the losses."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

LOG, PICTURE = "log.csv", "loss.png"

#: Part of the loss -> title of its panel.
_PANELS = {
    "flow": "flow: x, y, z, gripper\n(mean squared error)",
    "flow_rest": "flow: rotation\n(mean squared error)",
    "heat": "heat: patch of the named cube\n(cross-entropy, nats)",
    "position": "position of the named cube\n(smooth L1, decimetres)",
}
_PARTS = ("total", *_PANELS)
COLUMNS = ("step", "seconds", "learning_rate", *(f"train_{p}" for p in _PARTS), *(f"held_out_{p}" for p in _PARTS))

# Blue and orange of the Okabe-Ito palette, which colour-blind readers can tell apart.
_TRAINING, _HELD_OUT = "#0072B2", "#D55E00"


class LossLog:
    """Collects the losses of steps and writes their means. A training that goes on drops what came after `step`."""

    def __init__(self, folder: Path, step: int, say: Callable[[str], None]):
        self._path, self._picture, self._say = folder / LOG, folder / PICTURE, say
        self._collected: list[Mapping[str, float]] = []
        self._last = (step, 0.0)
        kept: list[dict[str, str]] = []
        if step and self._path.is_file():
            with self._path.open(newline="", encoding="utf-8") as file:
                kept = [row for row in csv.DictReader(file) if int(row["step"]) <= step]
        if kept:
            self._last = (step, float(kept[-1]["seconds"]))
        with self._path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(kept)

    def add(self, losses: Mapping[str, float]) -> None:
        """Collect the losses of one step."""
        self._collected.append(losses)

    def write(self, step: int, steps: int, seconds: float, rate: float, held_out: Mapping[str, float] | None) -> None:
        """Write the means since the last row, and the losses on held-out scenes if they were measured."""
        means = {name: float(np.mean([one[name] for one in self._collected])) for name in _PARTS}
        self._collected.clear()
        row: dict[str, object] = {"step": step, "seconds": f"{seconds:.1f}", "learning_rate": f"{rate:.3g}"}
        row |= {f"train_{name}": f"{value:.5f}" for name, value in means.items()}
        row |= {f"held_out_{name}": f"{value:.5f}" for name, value in (held_out or {}).items()}
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, COLUMNS, restval="").writerow(row)
        pace = (seconds - self._last[1]) / max(1, step - self._last[0])
        self._last = (step, seconds)
        parts = ", ".join(f"{name} {means[name]:.3f}" for name in _PANELS)
        on_held_out = ", ".join(f"{name} {held_out[name]:.3f}" for name in _PANELS) if held_out else ""
        self._say(
            f"step {step}/{steps}: {parts}{f' (held out: {on_held_out})' if held_out else ''}; {pace:.2f} s a step, "
            f"{pace * (steps - step) / 60:.0f} min left"
        )

    def draw(self) -> None:
        """Draw every part of the loss over the steps, on training and held-out scenes, into loss.png."""
        from matplotlib.figure import Figure

        with self._path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        figure = Figure(figsize=(12, 3.6), layout="constrained")
        for axis, (part, title) in zip(figure.subplots(1, len(_PANELS)), _PANELS.items(), strict=True):
            for prefix, label, colour, width in (
                ("train", "training (mean between rows)", _TRAINING, 1.0),
                ("held_out", "held-out scenes (averaged weights)", _HELD_OUT, 2.0),
            ):
                points = [(int(row["step"]), float(row[f"{prefix}_{part}"])) for row in rows if row[f"{prefix}_{part}"]]
                # One measurement is a line without length: its marker shows it.
                marker = "o" if len(points) == 1 else ""
                x, y = zip(*points, strict=True) if points else ((), ())
                axis.plot(x, y, color=colour, linewidth=width, marker=marker, label=label)
            axis.set_yscale("log")
            axis.set_title(title, fontsize=9)
            axis.set_xlabel("step")
            axis.grid(visible=True, which="both", alpha=0.25)
        figure.axes[0].set_ylabel("loss (log scale)")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
        figure.savefig(self._picture, dpi=110)
