"""How pictures look: on a screen, or in a paper; where they are saved, and the caption files of the latter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.output_files import replacing, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

StyleName: TypeAlias = Literal["screen", "paper"]
#: Columns of a page in a two-column paper, in inches: one, and both.
_ONE_COLUMN, _BOTH_COLUMNS = 3.35, 6.9
#: Of rows of pictures on a screen, in inches.
_WIDE = 8.4
_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same picture on every machine
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "hatch.linewidth": 0.6,
    "pdf.fonttype": 42,  # text stays text in vector files
    "svg.fonttype": "none",
    "text.parse_math": False,  # instructions and group names may hold $ and _
}


@dataclass(frozen=True)
class Style:
    """Sizes of a style. A paper's pictures have no title inside, text of 7 to 9 points, and a caption file.

    inches: of a picture on a screen that need not be wide.
    """

    name: StyleName = "screen"
    inches: float = 8.4

    @property
    def paper(self) -> bool:
        """Whether it is for print."""
        return self.name == "paper"

    @property
    def formats(self) -> tuple[str, ...]:
        """A paper's pictures are vectors; the PNG is to look at."""
        return ("png", "pdf") if self.paper else ("png",)

    @property
    def dpi(self) -> int:
        """Dots per inch of a PNG."""
        return 300 if self.paper else 150

    def width(self, wide: bool) -> float:
        """Inches of a picture of one column, or with `wide` of both."""
        if self.paper:
            return _BOTH_COLUMNS if wide else _ONE_COLUMN
        return max(self.inches, _WIDE) if wide else self.inches

    def scaled(self, inches: float) -> float:
        """A height that is right on a screen, in this style."""
        return inches * (0.72 if self.paper else 1.0)

    @property
    def characters_per_inch(self) -> float:
        """Of running text in its title size, on the safe side."""
        return 14 if self.paper else 11

    @contextmanager
    def settings(self) -> Iterator[None]:
        """matplotlib's settings within the block; the caller's are there again afterwards."""
        import matplotlib as mpl

        size = 7 if self.paper else 8
        # A plain dict: matplotlib's stubs want literal names, which differ from one of its versions to the next.
        more: Any = {
            **_SETTINGS,
            "font.size": size + 1,
            "axes.titlesize": size + 1,
            "axes.labelsize": size + 1 - self.paper * 0.5,
            "legend.fontsize": size,
            "xtick.labelsize": size,
            "ytick.labelsize": size,
            "lines.linewidth": 1.2 if self.paper else 1.6,
            "savefig.dpi": self.dpi,
        }
        with mpl.rc_context(more):
            yield


def new_canvas(width: float, height: float) -> Canvas:
    """A matplotlib figure of width x height inches on the Agg canvas: no window system, no global state of pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(canvas)
    return canvas


def save_canvas(canvas: Canvas, figure: Figure, folder: Path, style: Style, formats: Sequence[str] = ()) -> list[Path]:
    """Save NAME.png (and other formats), for a paper NAME_caption.md and .tex too; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    find_places(canvas, style.dpi)
    for kind in formats or style.formats:
        path = folder / f"{figure.name}.{kind}"
        # Without a creation date the same data give the same file.
        metadata = {"CreationDate": None} if kind == "pdf" else None
        with replacing(path) as temporary:
            canvas.savefig(temporary, format=kind, dpi=style.dpi, metadata=metadata)
        paths.append(path)
    if style.paper:
        caption = f"{figure.title}. {figure.caption}".strip()
        for ending, text in (("md", caption), ("tex", f"\\caption{{{_for_latex(caption)}}}")):
            paths.append(folder / f"{figure.name}_caption.{ending}")
            write_text(paths[-1], f"{text}\n")
    return paths


def find_places(canvas: Canvas, dpi: int) -> None:
    """Find them once, for every format. While a figure has a layout engine, matplotlib draws all of it twice."""
    engine = canvas.get_layout_engine()
    if engine is not None:
        canvas.set_dpi(dpi)
        engine.execute(canvas)
        canvas.set_layout_engine(None)


_LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
}  # fmt: skip


def _for_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
