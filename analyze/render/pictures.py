"""Figures of kind `pictures`: stored pictures as the cameras saw them, in rows and columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.style import Style, new_canvas
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.analyze.show.plot_text import wrapped
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


def pictures(figure: Figure, style: Style) -> Canvas:
    """A picture for each row of the frame, whose columns are row, column, label, store, episode, replan and camera."""
    num_rows, num_columns = ((max(figure.frame[name].to_list()) + 1) for name in ("row", "column"))
    width = style.width(wide=True)
    canvas = new_canvas(width, num_rows * (width / num_columns + 0.25) + 0.3)
    grid = canvas.subplots(num_rows, num_columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    stores: dict[str, Store] = {}
    for one in figure.frame.iter_rows(named=True):
        store = stores.setdefault(one["store"], open_store(store_place(one["store"])))
        view = next(view for view in store.attributes.policy.cameras if view.name == one["camera"])
        episode = next(episode for episode in store.episodes if episode.name == one["episode"])
        axes = grid[one["row"], one["column"]]
        axes.imshow(upright(episode.read(f"frames/{one['camera']}", one["replan"]), view))
        axes.set_title(wrapped(one["label"], int(width / num_columns * style.characters_per_inch), 2))
    if not style.paper:
        canvas.suptitle(wrapped(figure.title, int(width * style.characters_per_inch), 1), x=0.01, ha="left", size=10)
    return canvas
