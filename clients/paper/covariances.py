"""Figure 6 in numbers: how much of the covariance clustering gathers in blocks."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clients.paper.methods import SHARED, MixtureMap
from gpom_core.kernels import gram

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Ordering:
    """The covariance of all n observations in one order.

    Attributes:
        covariance: (n, n), signal variance 1, without noise.
        edges: (k + 1,) where the blocks of the clusters begin and end; one block: no clusters.
        facts: `energy_share`, the share of the squared covariance off the diagonal that is inside
            the blocks; `area_share`, the share of the pairs that is, which is what a clustering
            that knows nothing would gather; `merit`, their ratio.
    """

    name: str
    covariance: Floats
    edges: NDArray[np.int64]
    facts: dict[str, float]


def covariance_orderings(maps: Mapping[str, MixtureMap]) -> list[Ordering]:
    """As the scans came, and cluster by cluster for each clustering."""
    orderings: list[Ordering] = []
    for name, found in maps.items():
        geometry = np.concatenate([c.observations.geometry for c in found.clusters])
        kinds = np.concatenate([c.observations.kinds for c in found.clusters])
        covariance = gram(kinds, geometry, SHARED.length_scale_m)
        sizes = [len(c.observations) for c in found.clusters]
        edges = np.concatenate([[0], np.cumsum(sizes)])
        if not orderings:
            beam = np.concatenate([c.beam for c in found.clusters])
            time = np.argsort(beam, kind="stable")
            whole = np.array([0, len(beam)])
            before = covariance[np.ix_(time, time)]
            orderings.append(_ordering("in order of time", before, whole))
        orderings.append(_ordering(f"{name}: {len(sizes)} clusters", covariance, edges))
    return orderings


def _ordering(name: str, covariance: Floats, edges: NDArray[np.int64]) -> Ordering:
    n = len(covariance)
    energy = covariance**2
    np.fill_diagonal(energy, 0.0)
    inside = sum(float(energy[a:b, a:b].sum()) for a, b in pairwise(edges))
    sizes = np.diff(edges)
    energy_share = inside / float(energy.sum())
    area_share = float((sizes * (sizes - 1)).sum()) / (n * (n - 1))
    facts = {
        "energy_share": energy_share,
        "area_share": area_share,
        "merit": energy_share / area_share,
    }
    return Ordering(name, covariance, edges, facts)
