"""The results file `attention_ratio_results_<suite>.json`: a list of episodes, structured as by the published scripts.

It differs from the published scripts' files in four points: a ratio that is not finite is null (they write Infinity,
which is not JSON), summaries count such ratios in `num_nonfinite`, a summary over no finite ratio is null (they write
0.0), and steps and episodes have fields that theirs lack: what the fractions are of and how many keys each side has
(which the published guide tells its readers to look at), and what the numbers are about. docs/reading.md
describes all of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import unquote

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.safe_text import file_part

RESULTS_PREFIX = "attention_ratio_results_"
#: What `EpisodeResult.num_steps` counts: see `loop_counter`.
NumStepsDefinition = Literal["loop_counter"]


class ResultsError(UserError, ValueError):
    """A results file that cannot be read or written."""


class ResultsNotFound(ResultsError, FileNotFoundError):
    """No results file at the given path."""


@dataclass(frozen=True)
class FrameProxy:
    """What the published Cosmos scripts measure: the ratio of two latent frames' masses in self-attention.

    The queries are those of one frame. Masses are sums over the queries; fractions are fractions of the two frames'
    masses. `selected_call_s` is the sequence length of the call whose rows are used, the frames have the names that the
    user gave, and `num_queries` is the number of queries in the frame.
    """

    selected_call_s: int
    query_frame: str
    visual_frame: str
    text_frame: str
    num_queries: int

    def fields(self) -> dict[str, int | str]:
        """The fields that it adds to every step of a results file, under their published names."""
        return {
            "selected_call_S": self.selected_call_s,
            "query_frame": self.query_frame,
            "visual_frame": self.visual_frame,
            "text_frame": self.text_frame,
        }


class StepRatio(Document, frozen=True):
    """One replan. `step` is the environment step index, waiting steps included; masses and fractions are without unit.

    `total_mass` is what the fractions are of: the sum of all groups' masses (for a ratio of latent frames, of the two
    frames' masses). `num_visual_tokens` and `num_text_tokens` are the numbers of keys on the two sides, fractional
    where objects cover parts of patches; their quotient is the ratio that uniform attention gives, and they are null
    where it is another one, because queries, layers or heads see different keys. The three are absent in files of the
    published scripts. The last four fields are set only for a ratio of latent frames (see `FrameProxy`).
    """

    step: int
    visual_linguistic_ratio: float | None
    visual_mass: float
    linguistic_mass: float
    visual_fraction: float | None
    linguistic_fraction: float | None
    action_mass: float | None = None
    action_fraction: float | None = None
    total_mass: float | None = None
    num_visual_tokens: float | None = None
    num_text_tokens: float | None = None
    selected_call_S: int | None = None
    query_frame: str | None = None
    visual_frame: str | None = None
    text_frame: str | None = None


class RatioSummary(Document, frozen=True):
    """Ratio over the replans of an episode: finite ones only, ddof 0; `num_nonfinite` counts the others."""

    mean: float | None
    std: float | None
    median: float | None
    min: float | None
    max: float | None
    num_nonfinite: int


class MeanStd(Document, frozen=True):
    """Mean and standard deviation (ddof 0) over the replans of an episode."""

    mean: float | None
    std: float | None


class LayerSummary(Document, frozen=True):
    """One layer of one episode. `num_steps` is the number of replans that are summarized."""

    visual_linguistic_ratio: RatioSummary
    visual_mass: MeanStd
    linguistic_mass: MeanStd
    visual_fraction: MeanStd
    linguistic_fraction: MeanStd
    num_steps: int
    action_mass: MeanStd | None = None
    action_fraction: MeanStd | None = None


class EpisodeResult(Document, frozen=True):
    """One episode. Keys of `summary` and `per_step_ratios`: `layer_N` for every layer, and `layers_avg`.

    `num_steps` is the counter of the published scripts' loop when it stops (`loop_counter`); `num_steps_definition`
    says so, and is absent in their files. `grouping` and `grouping_description` say what visual and linguistic are,
    `denoise_steps` which denoise steps the masses are means over; all three are absent in those files, too.
    """

    task_id: int
    episode_idx: int
    task_description: str
    success: bool
    num_steps: int
    summary: dict[str, LayerSummary]
    per_step_ratios: dict[str, list[StepRatio]]
    num_steps_definition: NumStepsDefinition | None = None
    grouping: str | None = None
    grouping_description: str | None = None
    denoise_steps: list[int] | None = None


def loop_counter(wait_steps: int, num_actions: int, success: bool) -> int:
    """The published scripts' counter when their loop stops: waiting steps and executed actions.

    The loop is left before it counts the action that solves the task: an episode that the k-th action after 10 waiting
    steps solves has 10 + k - 1.
    """
    return wait_steps + num_actions - success


def results_file_name(suite: str) -> str:
    """File name of a suite's results; see `safe_text.file_part`."""
    return f"{RESULTS_PREFIX}{file_part(suite)}.json"


def suite_of_results_file(path: Path) -> str:
    """The suite of a results file: its name without prefix and ending."""
    return unquote(path.stem.removeprefix(RESULTS_PREFIX))
