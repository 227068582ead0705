import numpy as np
import pytest
from scipy.special import erf

from gpom_core.quadrature import LONGEST, MAX_NODES, fill_rule, node_count, panel_count, rule_size


def rule(length: float) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.empty(rule_size(length)), np.empty(rule_size(length))
    assert fill_rule(length, nodes, weights) == nodes.size
    return nodes, weights


@pytest.mark.parametrize("length", [*LONGEST[3:].tolist(), 30.0, 100.0])
def test_longest_lengths_are_averaged_to_1e_10(length: float) -> None:
    nodes, weights = rule(length)
    s = np.linspace(-8.0, length + 8.0, 1001)
    true = np.sqrt(np.pi / 2) / length * (erf((length - s) / np.sqrt(2)) + erf(s / np.sqrt(2)))
    got = np.exp(-0.5 * (s[:, None] - length * nodes) ** 2) @ weights
    assert np.abs(got - true).max() < 1.1e-10


@pytest.mark.parametrize("length", [0.0, *LONGEST[:3].tolist()])
def test_short_lengths_are_averaged_to_1e_10(length: float) -> None:
    nodes, weights = rule(length)
    x, w = np.polynomial.legendre.leggauss(8)
    s = np.linspace(-8.0, 8.0, 1001)[:, None]
    true = np.exp(-0.5 * (s - length * (x + 1) / 2) ** 2) @ (w / 2)
    got = np.exp(-0.5 * (s - length * nodes) ** 2) @ weights
    assert np.abs(got - true).max() < 1.1e-10


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.3, 5.0, 13.0, 14.0, 1000.0])
def test_weights_sum_to_one_and_nodes_rise_inside(length: float) -> None:
    nodes, weights = rule(length)
    assert weights.sum() == pytest.approx(1.0, rel=1e-13)
    assert (weights > 0).all()
    assert (np.diff(nodes) > 0).all()
    assert nodes.min() > 0
    assert nodes.max() < 1
    assert rule_size(length) == panel_count(length) * node_count(length)
    assert node_count(length) <= MAX_NODES
