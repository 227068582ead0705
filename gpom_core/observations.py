"""Observations of one expert: what was seen where, merged, as frozen arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpom_core.clusters import Clusters
from gpom_core.jit import compiled
from gpom_core.rows import BOX, COORDINATE_BITS, NONE, POINT, SEGMENT, Rows

OCCUPIED, FREE = 1.0, -1.0
LEAST_COUNT = 1e-3  # a beam that grazes a cell; less is not worth a different noise


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What one expert is trained on; n observations in d dimensions.

    Attributes:
        kinds: (n,) uint8, see `gpom_core.kernels.Kind`.
        geometry: (n, 2, d) metres: point twice, segment's ends, or box's low and high corner.
        targets: (n,) +1 for hits, -1 for what is free.
        noise_variance: (n,) of the merged target.
        count: (n,) how many observations were merged.
    """

    kinds: NDArray[np.uint8]
    geometry: NDArray[np.float64]
    targets: NDArray[np.float64]
    noise_variance: NDArray[np.float64]
    count: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = len(self.kinds)
        for name in ("targets", "noise_variance", "count"):
            if getattr(self, name).shape != (n,):
                raise ValueError(
                    f"{name} has shape {getattr(self, name).shape}, expected ({n},) like kinds"
                )
        if self.geometry.ndim != 3 or self.geometry.shape[:2] != (n, 2):
            raise ValueError(f"geometry has shape {self.geometry.shape}, expected ({n}, 2, d)")

    def __len__(self) -> int:
        return len(self.kinds)


@compiled
def gather(rows: Rows, clusters: Clusters, c: int) -> NDArray[np.int64]:
    """Rows of cluster `c` in order of kind and key, whatever order they came in."""
    out = np.empty(clusters.rows[c], np.int64)
    row = clusters.head[c]
    for i in range(len(out)):
        out[i] = row
        row = rows.after[row]
    first = np.argsort(rows.keys[out, 1], kind="mergesort")
    out = out[first]
    return out[np.argsort(rows.keys[out, 0], kind="mergesort")]


@compiled
def merge_areas(
    key: NDArray[np.int64],
    count: NDArray[np.float64],
    near: NDArray[np.float64],
    cell_m: float,
    levels: int,
    coarsen_ratio: float,
    cap: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Merge free areas four by four into coarser ones where no surface is near.

    Four known quarters are merged when their nearest hit is farther than `coarsen_ratio` of their
    edges, so that fine areas remain where the map bends.

    Args:
        key: (n,) lattice keys. count: (n,). near: (n,) distance to the nearest hit.

    Returns:
        geometry (m, 2, 2), and (m,) the sums of the counts, whole and each capped at `cap`.
    """
    n = len(key)
    offset = 1 << (COORDINATE_BITS - 1)
    mask = (1 << COORDINATE_BITS) - 1
    ix = ((key >> COORDINATE_BITS) & mask) - offset
    iy = (key & mask) - offset
    count, near = count.copy(), near.copy()
    weight = np.minimum(count, cap)
    geometry = np.empty((n, 2, 2))
    total, capped = np.empty(n), np.empty(n)
    done = 0
    for level in range(levels + 1):
        edge = cell_m * 2**level
        order = np.argsort(((ix >> 1) << 32) + (iy >> 1), kind="mergesort")
        kept = 0
        i = 0
        while i < len(order):
            j = i + 1
            nearest, seen, summed = near[order[i]], count[order[i]], weight[order[i]]
            px, py = ix[order[i]] >> 1, iy[order[i]] >> 1
            while j < len(order) and ix[order[j]] >> 1 == px and iy[order[j]] >> 1 == py:
                nearest = min(nearest, near[order[j]])
                seen += count[order[j]]
                summed += weight[order[j]]
                j += 1
            if level < levels and j - i == 4 and nearest > coarsen_ratio * edge:
                # The parent takes the place of a child that has been read already.
                first = order[i]
                near[first], count[first], weight[first] = nearest, seen, summed
                order[kept] = first
                kept += 1
            else:
                for k in range(i, j):
                    o = order[k]
                    geometry[done, 0, 0] = ix[o] * edge
                    geometry[done, 0, 1] = iy[o] * edge
                    geometry[done, 1, 0] = (ix[o] + 1) * edge
                    geometry[done, 1, 1] = (iy[o] + 1) * edge
                    total[done], capped[done] = count[o], weight[o]
                    done += 1
            i = j
        parents = order[:kept]
        ix, iy = ix[parents] >> 1, iy[parents] >> 1
        count, weight, near = count[parents], weight[parents], near[parents]
        if kept == 0:
            break
    return geometry[:done], total[:done], capped[:done]


def observations_of(  # noqa: PLR0913 - numbers, all by name
    rows: Rows,
    clusters: Clusters,
    cluster: int,
    *,
    cell_m: float,
    levels: int,
    coarsen_ratio: float,
    hit_noise_std: float,
    free_noise_std: float,
    hit_cap: float,
    free_cap: float,
) -> Observations:
    """The observations of one cluster, free areas merged where no surface is near."""
    mine = gather(rows, clusters, cluster)
    kind = rows.kind[mine]
    areas, others = mine[kind == BOX], mine[kind != BOX]
    box_geometry, box_count, box_weight = merge_areas(
        rows.keys[areas, 0], rows.count[areas], rows.near[areas],
        cell_m, levels, coarsen_ratio, free_cap,
    )  # fmt: skip
    kinds = np.concatenate([rows.kind[others], np.full(len(box_count), BOX, np.uint8)])
    hit = kinds == POINT
    cap = np.where(hit, hit_cap, free_cap)[: len(others)]
    weight = np.concatenate([np.minimum(rows.count[others], cap), box_weight])
    return Observations(
        kinds=kinds,
        geometry=np.concatenate([rows.geometry[others], box_geometry]),
        targets=np.where(hit, OCCUPIED, FREE),
        noise_variance=np.where(hit, hit_noise_std**2, free_noise_std**2)
        / np.maximum(weight, LEAST_COUNT),
        count=np.concatenate([rows.count[others], box_count]),
    )


__all__ = ["BOX", "NONE", "POINT", "SEGMENT", "Observations", "gather", "observations_of"]
