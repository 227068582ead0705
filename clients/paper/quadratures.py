"""Integral kernels by numerical rules alone, as the paper has them, against the exact form.

A rule turns every beam into weighted points; the kernel between beams is the weighted sum over
all pairs of points. `gpom_core.kernels` integrates one of the two in closed form instead.
"""

from dataclasses import dataclass
from time import process_time
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clients.paper.methods import MixtureMap
from clients.paper.regions import Cells
from gpom_core import kernels
from gpom_core.beam_calibration import calibrated
from gpom_core.expert import Gram, train
from gpom_core.mixture import Mixture
from gpom_core.quadrature import MAX_NODES, fill_rule, node_count, panel_count

Floats = NDArray[np.float64]
Kinds = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Quadrature:
    """Kernels by a rule along every beam; hits stay points.

    Attributes:
        rule: composite Simpson, or Gauss-Legendre with nodes by length.
        step: of Simpson, in length scales; at most so far apart are its points.
    """

    rule: Literal["simpson", "gauss_legendre"]
    step: float = 0.5

    def gram(self, _kinds: Kinds, geometry: Floats, length_scale_m: float) -> Floats:
        """As `kernels.gram`, of points and segments."""
        nodes, weights, first = self._nodes(geometry, length_scale_m)
        k = _gaussian(nodes, nodes) * weights[:, None] * weights
        along = np.add.reduceat(k, first, axis=1)
        return np.asarray(np.add.reduceat(along, first, axis=0))

    def cross(
        self, _kinds: Kinds, geometry: Floats, points: Floats, length_scale_m: float
    ) -> Floats:
        """As `kernels.cross`, of points and segments."""
        nodes, weights, first = self._nodes(geometry, length_scale_m)
        k = _gaussian(points / length_scale_m, nodes) * weights
        return np.asarray(np.add.reduceat(k, first, axis=1))

    def _nodes(
        self, geometry: Floats, length_scale_m: float
    ) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Whitened nodes (N, 2), weights (N,), and the first node of each shape (n,)."""
        nodes, weights, first = [], [], []
        filled = 0
        for start, end in geometry / length_scale_m:
            share, weight = self._unit_rule(float(np.hypot(*(end - start))))
            nodes.append(start + share[:, None] * (end - start))
            weights.append(weight)
            first.append(filled)
            filled += len(share)
        return np.concatenate(nodes), np.concatenate(weights), np.array(first, np.intp)

    def _unit_rule(self, length: float) -> tuple[Floats, Floats]:
        """Positions in [0, 1] and weights that sum to 1."""
        if length == 0.0:
            return np.zeros(1), np.ones(1)
        if self.rule == "gauss_legendre":
            size = panel_count(length) * node_count(length)
            share, weight = np.empty(size), np.empty(size)
            fill_rule(length, share, weight)
            return share, weight
        pairs = max(1, int(np.ceil(length / self.step / 2.0)))
        weight = np.full(2 * pairs + 1, 2.0)
        weight[1::2] = 4.0
        weight[[0, -1]] = 1.0
        return np.linspace(0.0, 1.0, 2 * pairs + 1), weight / (6.0 * pairs)


RULES = {
    "Simpson, step 2 l": Quadrature("simpson", 2.0),
    "Simpson, step 1 l": Quadrature("simpson", 1.0),
    "Simpson, step l/2": Quadrature("simpson", 0.5),
    f"Gauss-Legendre, up to {MAX_NODES} nodes": Quadrature("gauss_legendre"),
}


def compare_rules(fitted: MixtureMap, cells: Cells) -> dict[str, dict[str, float]]:
    """Each rule's largest kernel error, its time for all experts' matrices, and its map's scores.

    The hyperparameters are those learned with the exact kernels.
    """
    exact, exact_s = _grams(fitted, kernels.gram)
    out = {"exact": {"gram_error": 0.0, "gram_s": exact_s, **_scores(fitted.mixture, cells)}}
    for name, rule in RULES.items():
        grams, seconds = _grams(fitted, rule.gram)
        error = max(float(np.abs(a - b).max()) for a, b in zip(grams, exact, strict=True))
        out[name] = {"gram_error": error, "gram_s": seconds}
        out[name] |= _scores(_retrained(fitted, rule), cells)
    return out


def _grams(fitted: MixtureMap, gram: Gram) -> tuple[list[Floats], float]:
    started = process_time()
    found = [
        gram(e.observations.kinds, e.observations.geometry, e.hyperparameters.length_scale_m)
        for e in fitted.mixture.experts
    ]
    return found, process_time() - started


def _retrained(fitted: MixtureMap, rule: Quadrature) -> Mixture:
    experts = tuple(
        train(cluster.observations, expert.hyperparameters, rule.gram)
        for cluster, expert in zip(fitted.clusters, fitted.mixture.experts, strict=True)
    )
    return calibrated(Mixture(experts, cross=rule.cross), fitted.clusters, fitted.beams)


def _scores(mixture: Mixture, cells: Cells) -> dict[str, float]:
    found = cells.scores(mixture.occupancy(cells.points))["observed"]
    return {"auc": found["auc"], "nll": found["nll"]}


def _gaussian(a: Floats, b: Floats) -> Floats:
    squared = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
    return np.asarray(np.exp(-0.5 * squared))
