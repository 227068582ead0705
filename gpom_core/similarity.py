"""Which returning beam is most like one that met nothing (section 3.1 of Kim & Kim)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.averages import CUTOFF
from gpom_core.jit import compiled
from gpom_core.kernels import point_segment
from gpom_core.quadrature import fill_rule, rule_size

NEIGHBOURS = 4  # returning beams on each side, in order of angle, that a silent one may follow


@compiled
def most_similar(
    beams: NDArray[np.float64], returned: NDArray[np.bool_], length_scale_m: float
) -> NDArray[np.int64]:
    """Returning beam of largest segment-segment kernel with each beam that did not return.

    Of each pair the silent beam is integrated in closed form and the other by Gauss-Legendre.
    The order of beams is taken as a ring: on a scanner that turns all around it is one.

    Args:
        beams: (n, 2) ends of the beams relative to the sensor, metres, in order of angle.
        returned: (n,) at least one.

    Returns:
        (n,) numbers of beams; a beam that returned is its own.
    """
    back = np.flatnonzero(returned)
    inverse = np.full(2, 1.0 / length_scale_m)
    length = np.sqrt(beams[:, 0] ** 2 + beams[:, 1] ** 2)
    first = np.zeros(len(back) + 1, np.int64)
    for k in range(len(back)):
        first[k + 1] = first[k] + rule_size(length[back[k]] / length_scale_m)
    node, weight = np.empty(first[-1]), np.empty(first[-1])
    for k in range(len(back)):
        fill_rule(length[back[k]] / length_scale_m, node[first[k] :], weight[first[k] :])
    candidates = min(2 * NEIGHBOURS, len(back))
    out = np.arange(len(beams))
    shape, point = np.zeros((2, 2)), np.empty(2)
    passed = 0
    for i in range(len(beams)):
        if returned[i]:
            passed += 1
            continue
        shape[1] = beams[i]
        best = -1.0
        for c in range(candidates):
            k = (passed - candidates // 2 + c) % len(back)
            other = beams[back[k]]
            along = other[0] * beams[i, 0] + other[1] * beams[i, 1]
            across = abs(other[0] * beams[i, 1] - other[1] * beams[i, 0]) / length[i]
            leaves = across if along > 0.0 else length[back[k]]  # how far apart they end
            value = 0.0
            for q in range(first[k], first[k + 1]):
                if node[q] * leaves > CUTOFF * length_scale_m:
                    break
                point[0], point[1] = node[q] * other[0], node[q] * other[1]
                value += weight[q] * point_segment(shape, point, inverse)
            if value > best:
                best = value
                out[i] = back[k]
    return out
