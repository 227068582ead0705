"""Learning curves and reliability diagrams of a comparison. Needs matplotlib."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from PIL import Image

from clients.comparison.study import Round
from clients.comparison.targets import GRID, MAP, TUNED_GRID

_COLOURS = {
    MAP: "tab:blue", GRID: "tab:orange", TUNED_GRID: "tab:red", "log-odds grid": "0.6",
    "OctoMap": "0.3", "GP classifier": "tab:olive", "Hilbert map": "tab:purple",
}  # fmt: skip
_RELIABILITY = {MAP: "tab:blue", "gpom uncalibrated": "0.6", GRID: "tab:orange"}
_NOT_CURVES = {"gpom uncalibrated"}
_PANEL_IN = (3.3, 2.9)
_DPI = 80
_COLOUR_COUNT = 64
_FEWEST = 20  # points in a bin; fewer say nothing about a frequency


def draw(rounds: Sequence[Round], folder: Path) -> list[Path]:
    """Draw all figures; the files written."""
    logs = list(dict.fromkeys(one.log for one in rounds))
    curves, diagrams = folder / "learning_curves.png", folder / "reliability.png"
    _save(_learning_curves(rounds, logs), curves)
    _save(_reliability(rounds, logs), diagrams)
    return [curves, diagrams]


def _save(figure: Figure, path: Path) -> None:
    """Write a PNG of few colours: a third of the size, and no eye sees it."""
    drawn = BytesIO()
    figure.savefig(drawn, dpi=_DPI)
    Image.open(drawn).convert("RGB").quantize(_COLOUR_COUNT).save(path, optimize=True)


def _panels(rows: int, columns: int) -> tuple[Figure, Any]:
    size = (_PANEL_IN[0] * columns, _PANEL_IN[1] * rows)
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _learning_curves(rounds: Sequence[Round], logs: Sequence[str]) -> Figure:
    figure, panels = _panels(1, len(logs))
    for axes, log in zip(panels[0], logs, strict=True):
        mine = [one for one in rounds if one.log == log]
        methods = [r.method for r in mine[0].results if r.method not in _NOT_CURVES]
        for method in methods:
            scores = [one.of(method).scores["nll"] for one in mine]
            axes.errorbar(
                [one.training_scans for one in mine], [s.mean for s in scores],
                [s.std for s in scores], marker="o", markersize=3, linewidth=1.2, label=method,
                color=_COLOURS.get(method),
            )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="training scans", title=log)
        axes.xaxis.set_major_locator(FixedLocator([one.training_scans for one in mine]))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
        axes.tick_params(which="both", labelsize=7)
    panels[0][0].set_ylabel("negative log likelihood")
    panels[0][0].legend(fontsize=7)
    return figure


def _reliability(rounds: Sequence[Round], logs: Sequence[str]) -> Figure:
    """The fullest map of each log above, the thinnest down to a tenth below."""
    shares = sorted({one.share for one in rounds}, reverse=True)
    thin = [share for share in shares if share * 10 >= 1][-1]
    shown = list(dict.fromkeys([shares[0], thin]))
    figure, panels = _panels(len(shown), len(logs))
    for row, share in zip(panels, shown, strict=True):
        for axes, log in zip(row, logs, strict=True):
            axes.plot([0, 1], [0, 1], color="0.8", linewidth=1)
            axes.set_title(f"{log}, share {share}", fontsize=9)
            for one in rounds:
                if one.log == log and one.share == share:
                    _curves(axes, one)
        row[0].set_ylabel("share occupied")
    for axes in panels[-1]:
        axes.set_xlabel("predicted probability")
    panels[0][0].legend(fontsize=7)
    return figure


def _curves(axes: Any, one: Round) -> None:
    for method, colour in _RELIABILITY.items():
        curve = one.of(method).reliability
        shown = np.asarray(curve.count) >= _FEWEST
        axes.plot(
            curve.predicted[shown], curve.observed[shown], marker="o", markersize=3,
            linewidth=1.2, color=colour, label=method,
        )  # fmt: skip
