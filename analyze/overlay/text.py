"""The shown replans of an overlay as a printed table."""

from __future__ import annotations

import numpy as np

from vla_attention.analyze.overlay.overlay_data import orientation_note
from vla_attention.analyze.overlay.overlay_study import OverlayStudy
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.analyze.show.tables import Column, Table, count, number, texts
from vla_attention.schemas.safe_text import visible

_LEGEND = (
    "%: camera's share of all image attention. most, at: highest lift of a patch, and its row,column in the picture as "
    "it is shown (numbers in the csv's row and column count as selectors do, in the stored picture)."
)


def overlay_sections(study: OverlayStudy) -> list[Section]:
    """A line per shown replan: ratio, each camera's share and brightest patch; and how the pictures were turned."""
    overlay, lift, ratio = study.overlay, study.overlay.values("lift"), study.overlay.ratio

    def of_camera(camera: str) -> tuple[Column, ...]:
        shown = {replan: upright(lift[camera][replan], overlay.views[camera]) for replan in study.replans}

        def share(replan: int) -> float:
            part = overlay.share(camera, replan)
            return float("nan") if part is None else 100 * part

        def place(replan: int) -> str:
            row, column = divmod(int(np.nan_to_num(shown[replan]).argmax()), shown[replan].shape[1])
            return f"{row},{column}"

        return (
            number(f"{camera} %", share),
            number("most", lambda replan: float(np.fmax.reduce(shown[replan], axis=None))),
            texts("at", place),
        )

    columns = [
        count("replan", int),
        count("step", lambda replan: overlay.env_step[replan]),
        *([] if ratio is None else [number("ratio", lambda replan: float(ratio[replan]))]),
        *(column for camera in overlay.maps for column in of_camera(camera)),
    ]
    item = overlay.item
    several = ratio is not None and len(study.question.selection.layers) > 1
    note = orientation_note(overlay)
    return [
        Section(
            [
                *study.question.remarks,
                f"{item.store.suite} {item.episode.name}: {visible(item.episode.attributes.instruction)}",
                Table(columns, study.replans),
                f"ratio: geometric mean of the layers. {_LEGEND}" if several else _LEGEND,
                [] if note else [""],  # what follows stands apart
            ]
        ),
        Section([note]),
    ]
