"""Gauss-Legendre rules sized by length, for averages of unit Gaussians along a line."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gpom_core.jit import compiled

# Largest whitened length over which 1, 2, 3, … nodes average exp(-(s - u)^2 / 2), for any s,
# with an absolute error below 1e-10.
LONGEST: Final[NDArray[np.float64]] = np.array(
    [
        *(4.8e-05, 0.01948, 0.1542, 0.4510, 0.8805, 1.4011, 1.9807, 2.5978),
        *(3.2387, 3.8945, 4.5595, 5.2300, 5.9035, 6.5783, 7.2534, 7.9280),
        *(8.6017, 9.2741, 9.9451, 10.6147, 11.2826, 11.9491, 12.6140, 13.2774),
    ]
)
MAX_NODES: Final = LONGEST.size


def _unit_rules() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights on [0, 1]; row n - 1 holds the rule of n nodes, padded with zeros."""
    nodes = np.zeros((MAX_NODES, MAX_NODES))
    weights = np.zeros((MAX_NODES, MAX_NODES))
    for n in range(1, MAX_NODES + 1):
        x, w = np.polynomial.legendre.leggauss(n)
        nodes[n - 1, :n] = (x + 1.0) / 2.0
        weights[n - 1, :n] = w / 2.0
    return nodes, weights


NODES, WEIGHTS = _unit_rules()


@compiled
def panel_count(length: float) -> int:
    """Equal panels that a whitened length is cut into, so that each fits the longest rule."""
    return max(1, int(np.ceil(length / LONGEST[MAX_NODES - 1])))


@compiled
def node_count(length: float) -> int:
    """Nodes of each panel of one whitened length."""
    panels = panel_count(length)
    n = 1
    while n < MAX_NODES and length > panels * LONGEST[n - 1]:
        n += 1
    return n


@compiled
def rule_size(length: float) -> int:
    """Number of nodes for one whitened length, all panels together."""
    return panel_count(length) * node_count(length)


@compiled
def fill_rule(length: float, nodes: NDArray[np.float64], weights: NDArray[np.float64]) -> int:
    """Write the rule for one whitened length: positions in [0, 1] and weights that sum to 1.

    Both outputs need room for `rule_size(length)` values, which is the number returned.
    """
    panels = panel_count(length)
    n = node_count(length)
    for panel in range(panels):
        for q in range(n):
            nodes[panel * n + q] = (panel + NODES[n - 1, q]) / panels
            weights[panel * n + q] = WEIGHTS[n - 1, q] / panels
    return panels * n
