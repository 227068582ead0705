"""Where test points lie, as the training scans saw it.

A map can mean what it says on average and be wrong behind every wall.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from clients.protocol import Bools, Floats, far_from_beams, hit_ends
from gpom_core.scan import Scan

FAR_M = 0.5  # from every training beam
AT_M, NEAR_M = 0.1, 0.5  # from the nearest training hit

AT, BEFORE, BEHIND, OPEN, FAR = "at a surface", "before it", "behind it", "in the open", "far"
PLACES = {
    AT: f"up to {AT_M:g} m from a training hit",
    BEFORE: f"up to {NEAR_M:g} m from one, on the side it was seen from",
    BEHIND: "as near, on the other side",
    OPEN: f"more than {NEAR_M:g} m from every training hit",
    FAR: f"more than {FAR_M:g} m from every training beam; in no other place",
}


def places(points: Floats, training: Sequence[Scan]) -> dict[str, Bools]:
    """Which points (N, 2) are in which of PLACES, (N,) each; every point is in one."""
    ends = [hit_ends(scan) for scan in training]
    hits = np.concatenate([np.empty((0, 2)), *ends])
    seen_from = np.repeat([scan.pose[:2] for scan in training], [len(e) for e in ends], axis=0)
    far = far_from_beams(points, training, FAR_M)
    if len(hits) == 0:
        nowhere = np.zeros(len(points), np.bool_)
        return {AT: nowhere, BEFORE: nowhere, BEHIND: nowhere, OPEN: ~far, FAR: far}
    distance_m, nearest = cKDTree(hits).query(points)
    beyond = np.sum((points - hits[nearest]) * (hits - seen_from)[nearest], axis=1) > 0.0
    at, near = distance_m <= AT_M, (distance_m > AT_M) & (distance_m <= NEAR_M)
    found = {AT: at, BEFORE: near & ~beyond, BEHIND: near & beyond, OPEN: distance_m > NEAR_M}
    return {**{place: mask & ~far for place, mask in found.items()}, FAR: far}
