"""Small pieces that the figures are put together from."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from clients.paper.experiment import BOUNDS_M
from clients.paper.regions import Cells
from clients.world import World

Floats = NDArray[np.float64]

HIT_COLOUR, FREE_COLOUR = "tab:blue", "tab:orange"
_PANEL_IN = (4.9, 4.0)
_DPI = 110


def new_figure(rows: int, columns: int) -> tuple[Figure, Any]:
    """Give a figure and its axes, (columns,) or (rows, columns)."""
    size = (_PANEL_IN[0] * columns, _PANEL_IN[1] * rows + 0.4)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(h_pad=0.12))
    return figure, figure.subplots(rows, columns)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    figure.savefig(path, dpi=_DPI)


def map_axes(axes: Axes, title: str) -> None:
    """Set up axes in metres, to scale."""
    xmin, ymin, xmax, ymax = BOUNDS_M
    axes.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.set_title(title, fontsize=10)


def walls(axes: Axes, world: World) -> None:
    """Draw the true surfaces."""
    segments(axes, world.segments(), "0.35", 1.2)


def segments(axes: Axes, ends: Floats, colour: Any, width: float) -> None:
    """Draw segments (n, 2, 2)."""
    axes.add_collection(LineCollection(list(ends), colors=[colour], linewidths=width))


def image(
    axes: Axes, cells: Cells, values: Floats, colours: str, low: float, high: float | None
) -> AxesImage:
    """Draw one value per cell."""
    xmin, ymin, _, _ = BOUNDS_M
    rows, columns = cells.shape
    size = cells.resolution_m
    extent = (xmin, xmin + columns * size, ymin, ymin + rows * size)
    return axes.imshow(
        values.reshape(cells.shape), origin="lower", extent=extent, cmap=colours, vmin=low,
        vmax=high, interpolation="nearest",
    )  # fmt: skip


def colour_bar(figure: Figure, axes: Axes, shown: AxesImage, label: str) -> None:
    """Say what the colours mean."""
    figure.colorbar(shown, ax=axes, shrink=0.75, aspect=18, label=label)


def cluster_colours(count: int) -> list[Any]:
    """Give colours that differ between neighbours in number."""
    turn = (np.arange(count) * 0.61803398875) % 1.0
    return [mpl.colormaps["hsv"](t * 0.95) for t in turn]
