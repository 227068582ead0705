"""The paper's figures, drawn from one trial."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from clients.paper.covariances import Ordering, covariance_orderings
from clients.paper.drawing import (
    FREE_COLOUR,
    HIT_COLOUR,
    cluster_colours,
    colour_bar,
    image,
    map_axes,
    new_figure,
    save,
    segments,
    walls,
)
from clients.paper.experiment import Experiment
from clients.paper.methods import Map, MixtureMap
from clients.paper.regions import Cells
from clients.paper.trials import Trial
from gpom_core.mixture import Mixture, beams_of

_ZOOM = 0.2  # of both rates, in the corner of the curves
_CUT = ", cut beams"


def draw_figures(trial: Trial, folder: Path) -> dict[str, object]:
    """Write all figures; what they show in numbers, ready for JSON."""
    dp, lt = _mixture(trial, "DP"), _mixture(trial, "LT")
    draw_scene(trial.experiment, folder / "fig1_scene.png")
    draw_clusters(trial.experiment, [dp, lt], folder / "fig3_clusters.png")
    draw_experts(trial.experiment, trial.cells, lt, folder / "fig4_experts.png")
    whole = [trial.maps[name] for name in ("grid", "single GP", "DP", "LT")]
    draw_maps(trial, whole, folder / "fig5_maps.png")
    cut = [trial.maps["grid"], *(m for name, m in trial.maps.items() if name.endswith(_CUT))]
    if len(cut) > 1:
        draw_maps(trial, cut, folder / "fig5_maps_cut_beams.png")
    orderings = covariance_orderings({"DP": dp, "LT": lt})
    draw_covariances(orderings, folder / "fig6_covariances.png")
    draw_curves(trial, folder / "fig7_roc.png")
    return {"fig6": {o.name: o.facts for o in orderings}}


def _mixture(trial: Trial, name: str) -> MixtureMap:
    found = trial.maps[name]
    if not isinstance(found, MixtureMap):
        raise TypeError(f"{name} is no mixture")
    return found


def draw_scene(experiment: Experiment, path: Path) -> None:
    """Fig. 1: the scene with one scan, and with all of them."""
    figure, (left, right) = new_figure(1, 2)
    one = experiment.robots[1].scans[6]
    for axes, scans, title in (
        (left, [one], "(a) one scan of robot 2: 17 beams, 8 m"),
        (right, experiment.scans, f"(b) all {len(experiment.scans)} scans"),
    ):
        beams = beams_of(scans)
        map_axes(axes, title)
        walls(axes, experiment.world)
        width = 0.4 if len(scans) > 1 else 1.0
        segments(axes, beams.segments[beams.returned], HIT_COLOUR, width)
        segments(axes, beams.segments[~beams.returned], FREE_COLOUR, width)
        axes.plot(*beams.end[beams.returned].T, "k.", markersize=4)
        for robot, marker in zip(experiment.robots, "os", strict=True):
            places = np.array([scan.pose[:2] for scan in robot.scans])
            axes.plot(*places.T, marker=marker, color="tab:green", markersize=4, linewidth=1)
    handles = [
        Line2D([], [], color=HIT_COLOUR, label="beam that returned"),
        Line2D([], [], color=FREE_COLOUR, label="beam without return"),
        Line2D([], [], color="k", marker=".", linestyle="", label="hit"),
        Line2D([], [], color="tab:green", marker="o", label="robot 1"),
        Line2D([], [], color="tab:green", marker="s", label="robot 2"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5)
    save(figure, path)


def draw_clusters(experiment: Experiment, maps: list[MixtureMap], path: Path) -> None:
    """Fig. 3: hits and beams in the colour of their cluster."""
    figure, axes_of = new_figure(1, len(maps))
    for axes, found, letter in zip(axes_of, maps, "ab", strict=False):
        count = len(found.clusters)
        map_axes(axes, f"({letter}) {found.name}: {count} clusters")
        walls(axes, experiment.world)
        for cluster, colour in zip(found.clusters, cluster_colours(count), strict=True):
            shapes, hit = cluster.observations.geometry, cluster.observations.targets > 0
            segments(axes, shapes[~hit], colour, 0.4)
            axes.plot(*shapes[hit, 0].T, "o", color=colour, markersize=4, markeredgecolor="k",
                      markeredgewidth=0.3)  # fmt: skip
    save(figure, path)


def draw_experts(experiment: Experiment, cells: Cells, found: MixtureMap, path: Path) -> None:
    """Fig. 4: single experts, each with its data, occupancy and variance."""
    hits = [c.observations.geometry[c.observations.targets > 0, 0] for c in found.clusters]
    on_l = [float((experiment.l_wall.distance(xy) < 0.1).mean()) * len(xy) for xy in hits]
    sizes = [len(xy) - own for xy, own in zip(hits, on_l, strict=True)]
    figure, rows = new_figure(2, 3)
    for row, e, name in zip(
        rows, (int(np.argmax(on_l)), int(np.argmax(sizes))), ("on the L", "elsewhere"), strict=True
    ):
        expert = found.mixture.experts[e]
        alone = Mixture((expert,), calibration=found.mixture.calibration)
        shapes, hit = expert.observations.geometry, expert.observations.targets > 0
        h = expert.hyperparameters
        map_axes(row[0], f"expert {name}: {hit.sum()} hits, {(~hit).sum()} beams")
        walls(row[0], experiment.world)
        segments(row[0], shapes[~hit], HIT_COLOUR, 0.6)
        row[0].plot(*shapes[hit, 0].T, "k.", markersize=5)
        map_axes(row[1], f"occupancy; l = {h.length_scale_m:.2f} m, s_f = {h.signal_std:.2f}")
        mean, variance = alone.latent(cells.points)
        shown = image(row[1], cells, alone.calibration.probability(mean, variance), "gray_r", 0, 1)
        colour_bar(figure, row[1], shown, "probability of being occupied")
        map_axes(row[2], "variance")
        shown = image(row[2], cells, variance, "viridis", 0, h.signal_std**2)
        colour_bar(figure, row[2], shown, "variance of the latent function")
    save(figure, path)


def draw_maps(trial: Trial, maps: list[Map], path: Path) -> None:
    """Fig. 5: truth, and every method's map with the variance of the processes."""
    figure, rows = new_figure(2, len(maps))
    cells, letters = trial.cells, iter("abcdefgh")
    panels: list[tuple[Axes, AxesImage, str]] = []
    for column, found in enumerate(maps):
        axes = rows[0][column]
        map_axes(axes, f"({next(letters)}) {found.name}")
        shown = image(axes, cells, found.occupancy(cells.points), "gray_r", 0, 1)
        panels.append((axes, shown, "probability of being occupied"))
    for column, found in enumerate(maps):
        axes = rows[1][column]
        if column == 0:
            map_axes(axes, f"({next(letters)}) truth")
            shown = image(axes, cells, cells.occupied.astype(float), "gray_r", 0, 1)
            panels.append((axes, shown, "occupied"))
            continue
        map_axes(axes, f"({next(letters)}) {found.name}, variance")
        shown = image(axes, cells, found.variance(cells.points), "viridis", 0, None)
        panels.append((axes, shown, "variance of the latent function"))
    for axes, shown, label in panels:
        colour_bar(figure, axes, shown, label)
    save(figure, path)


def draw_covariances(orderings: list[Ordering], path: Path) -> None:
    """Fig. 6: the covariance of all observations, as they came and cluster by cluster."""
    figure, axes_of = new_figure(1, len(orderings))
    for axes, o, letter in zip(axes_of, orderings, "abc", strict=False):
        shown = axes.imshow(o.covariance, cmap="magma_r", vmin=0, vmax=1, interpolation="nearest")
        for start, end in zip(o.edges[:-1], o.edges[1:], strict=True):
            box_x = [start, end, end, start, start]
            box_y = [start, start, end, end, start]
            axes.plot(np.array(box_x) - 0.5, np.array(box_y) - 0.5, color="tab:cyan", linewidth=0.7)
        axes.set(xlabel="observation", ylabel="observation")
        share = f"{o.facts['energy_share']:.0%} of the energy in {o.facts['area_share']:.0%} of it"
        axes.set_title(f"({letter}) {o.name}\n{share}", fontsize=10)
        colour_bar(figure, axes, shown, "covariance, signal variance 1")
    save(figure, path)


def draw_curves(trial: Trial, path: Path) -> None:
    """Fig. 7: receiver operating characteristic over what was in view."""
    figure, (left, right) = new_figure(1, 2)
    mask = trial.cells.regions["observed"]
    truth = trial.cells.occupied[mask]
    for number, (name, found) in enumerate(trial.maps.items()):
        score = found.occupancy(trial.cells.points[mask])
        order = np.argsort(-score, kind="stable")
        last = np.append(np.diff(score[order]) != 0.0, True)  # a tie is one step of the curve
        true_rate = np.concatenate([[0], np.cumsum(truth[order])[last] / truth.sum()])
        false_rate = np.concatenate([[0], np.cumsum(~truth[order])[last] / (~truth).sum()])
        area = np.trapezoid(true_rate, false_rate)
        style = "--" if name.endswith(_CUT) else "-"
        for axes in (left, right):
            axes.plot(false_rate, true_rate, style, color=f"C{number}", linewidth=1.4,
                      label=f"{name}: {area:.4f}")  # fmt: skip
    for axes in (left, right):
        axes.set(xlabel="false positive rate", ylabel="true positive rate")
        axes.grid(alpha=0.3)
    left.set(xlim=(0, 1), ylim=(0, 1), title="(a) observed area")
    right.set(xlim=(0, _ZOOM), ylim=(1 - 2 * _ZOOM, 1), title="(b) its corner")
    right.legend(title="area under the curve", fontsize=9)
    save(figure, path)


__all__ = ["Figure", "draw_figures"]
