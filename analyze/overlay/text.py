"""The shown replans of an overlay as a printed table."""

from __future__ import annotations

from vla_attention.analyze.overlay.overlay_data import orientation_note
from vla_attention.analyze.overlay.overlay_study import OverlayStudy
from vla_attention.analyze.show.headings import wrap, wrap_all
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.analyze.show.text_table import text_table
from vla_attention.schemas.safe_text import visible

_LEGEND = (
    "%: camera's share of all image attention. most, at: highest lift of a patch, and its row,column in the picture as "
    "it is shown (numbers in the csv's row and column count as selectors do, in the stored picture)."
)


def overlay_text(study: OverlayStudy) -> str:
    """A line per shown replan: ratio, each camera's share and brightest patch; and how the pictures were turned."""
    overlay = study.overlay
    header = ["replan", "step", *(["ratio"] if overlay.ratio is not None else [])]
    for camera in overlay.maps:
        header += [f"{camera} %", "most", "at"]
    lift, rows = overlay.values("lift"), []
    for replan in study.replans:
        cells = [str(replan), str(overlay.env_step[replan])]
        if overlay.ratio is not None:
            cells.append(format_number(float(overlay.ratio[replan])))
        for camera, mass in overlay.maps.items():
            shown = upright(lift[camera][replan], overlay.views[camera])
            row, column = divmod(int(shown.argmax()), shown.shape[1])
            image_mass = overlay.image_mass[replan]
            share = 100 * mass[replan].sum() / image_mass if image_mass else float("nan")
            cells += [format_number(float(share)), format_number(float(shown.max())), f"{row},{column}"]
        rows.append(cells)
    item = overlay.item
    several = overlay.ratio is not None and len(study.question.selection.layers) > 1
    legend = f"ratio: geometric mean of the layers. {_LEGEND}" if several else _LEGEND
    lines = [
        *wrap_all(study.question.remarks),
        *wrap(f"{item.store.suite} {item.episode.name}: {visible(item.episode.attributes.instruction)}"),
        text_table(header, rows),
        *wrap(legend),
        "",
        *wrap(orientation_note(overlay)),
    ]
    return "\n".join(lines)
