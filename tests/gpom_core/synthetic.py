"""Rooms with straight walls and what a scanner sees in them, for tests."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from gpom_core.evidence import Evidence
from gpom_core.expert import Expert
from gpom_core.kernels import cross
from gpom_core.observations import Observations
from gpom_core.rows import BOX, POINT
from gpom_core.scan import Pose2D, Scan

# A room of 6 m x 4 m, off the lattice, with a pillar and a door in its right wall.
ROOM = [
    ((-3.03, -2.02), (3.03, -2.02)),
    ((3.03, -2.02), (3.03, -0.4)),
    ((3.03, 0.4), (3.03, 2.02)),
    ((3.03, 2.02), (-3.03, 2.02)),
    ((-3.03, 2.02), (-3.03, -2.02)),
    ((1.02, 0.52), (1.52, 0.52)),
    ((1.52, 0.52), (1.52, 1.03)),
    ((1.52, 1.03), (1.02, 1.03)),
    ((1.02, 1.03), (1.02, 0.52)),
]
Walls = Sequence[tuple[tuple[float, float], tuple[float, float]]]


def cast(walls: Walls, x: float, y: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Range to the first wall along each direction (n,), inf if there is none."""
    a, b = np.array(walls)[:, 0], np.array(walls)[:, 1]
    u = np.column_stack([np.cos(angles), np.sin(angles)])[:, None]
    span, to = (b - a)[None], (a - (x, y))[None]
    cross = u[..., 0] * span[..., 1] - u[..., 1] * span[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (to[..., 0] * span[..., 1] - to[..., 1] * span[..., 0]) / cross
        s = (to[..., 0] * u[..., 1] - to[..., 1] * u[..., 0]) / cross
    return np.where((t > 0.0) & (s >= 0.0) & (s <= 1.0), t, np.inf).min(axis=1)


def scan_of(
    ranges: ArrayLike,
    x: float = 0.0,
    y: float = 0.0,
    yaw: float = 0.0,
    *,
    first: float = -np.pi,
    step: float | None = None,
    range_max: float = 8.0,
) -> Scan:
    """A scan of the given ranges, all around unless told otherwise."""
    values = np.asarray(ranges, np.float32)
    return Scan(
        pose=Pose2D(x, y, yaw),
        ranges_m=values,
        angle_min_rad=first,
        angle_increment_rad=2.0 * np.pi / len(values) if step is None else step,
        range_min_m=0.05,
        range_max_m=range_max,
    )


def look(
    x: float,
    y: float,
    yaw: float = 0.0,
    *,
    walls: Walls = ROOM,
    beams: int = 90,
    noise: float = 0.0,
    seed: int = 0,
    range_max: float = 8.0,
) -> Scan:
    """What a scanner at (x, y) sees of the walls, all around."""
    angles = yaw - np.pi + 2.0 * np.pi / beams * np.arange(beams)
    ranges = cast(walls, x, y, angles)
    ranges += noise * np.random.default_rng(seed).normal(size=beams)
    ranges[ranges > range_max] = np.inf
    return scan_of(ranges, x, y, yaw, range_max=range_max)


def tour(scans: int = 12, *, beams: int = 90, noise: float = 0.01) -> list[Scan]:
    """Scans along a curve through the room, from no place on an edge of the lattice."""
    t = np.linspace(0.0, 1.0, scans)
    return [
        look(
            -2.47 + 4.9 * s,
            -1.02 + 0.8 * np.sin(5.0 * s),
            3.0 * s,
            beams=beams,
            noise=noise,
            seed=i,
        )
        for i, s in enumerate(t)
    ]


def moved(scan: Scan, dx: float, dy: float) -> Scan:
    """The same scan, taken from elsewhere."""
    return replace(scan, pose=Pose2D(scan.pose.x_m + dx, scan.pose.y_m + dy, scan.pose.yaw_rad))


def points_observed(
    xy: ArrayLike, targets: ArrayLike, noise: ArrayLike = 0.1, count: ArrayLike = 1.0
) -> Observations:
    """Observations of points (n, 2)."""
    where = np.asarray(xy, np.float64)
    n = len(where)
    return Observations(
        kinds=np.full(n, POINT, np.uint8),
        geometry=np.repeat(where[:, None], 2, axis=1),
        targets=np.asarray(targets, np.float64),
        noise_variance=np.broadcast_to(np.asarray(noise, np.float64), n).copy(),
        count=np.broadcast_to(np.asarray(count, np.float64), n).copy(),
    )


def areas_observed(low: ArrayLike, edge: float, noise: float = 1.0) -> Observations:
    """Free squares with low corners (n, 2)."""
    corner = np.asarray(low, np.float64)
    n = len(corner)
    return Observations(
        kinds=np.full(n, BOX, np.uint8),
        geometry=np.stack([corner, corner + edge], axis=1),
        targets=np.full(n, -1.0),
        noise_variance=np.full(n, noise),
        count=np.ones(n),
    )


def both(a: Observations, b: Observations) -> Observations:
    """The observations of two as one."""
    return Observations(
        *(
            np.concatenate([getattr(a, name), getattr(b, name)])
            for name in ("kinds", "geometry", "targets", "noise_variance", "count")
        )
    )


def without(o: Observations, i: int) -> Observations:
    """All observations but number `i`."""
    keep = np.arange(len(o)) != i
    return Observations(
        o.kinds[keep], o.geometry[keep], o.targets[keep], o.noise_variance[keep], o.count[keep]
    )


def posterior(
    expert: Expert, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance from the kernels, without any cut-off (eq. 9 and 10)."""
    h, o = expert.hyperparameters, expert.observations
    k = h.signal_std**2 * cross(o.kinds, o.geometry, points, h.length_scale_m)
    explained = np.einsum("mi,mi->m", k @ expert.precision, k)
    return k @ expert.weights, h.signal_std**2 - explained


def weighed(expert: Expert, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """What hits and passes at points (n, 2) weigh, (2, n), observation by observation."""
    o, h = expert.observations, expert.hyperparameters
    weights = h.signal_std**2 / o.noise_variance
    out = np.zeros((2, len(points)))
    for kind, (low, high), weight in zip(o.kinds, o.geometry, weights, strict=True):
        start, end = (points - low) / h.length_scale_m, (points - high) / h.length_scale_m
        if kind == POINT:
            out[0] += weight * np.exp(-16.0 * (start**2).sum(axis=1))
        elif kind == BOX:
            out[1] += weight * (ndtr(start) - ndtr(end)).prod(axis=1)
        else:
            length = np.linalg.norm(high - low) / h.length_scale_m
            at = start @ (high - low) / (length * h.length_scale_m)
            across2 = (start**2).sum(axis=1) - at**2
            out[1] += weight * np.exp(-0.5 * across2) * (ndtr(at) - ndtr(at - length))
    return out


def evidence_by_key(evidence: Evidence) -> dict[tuple[int, int], tuple[float, NDArray[np.float64]]]:
    """Count and geometry of every row, by its key."""
    rows = evidence.rows
    return {
        (int(rows.keys[i, 0]), int(rows.keys[i, 1])): (
            float(rows.count[i]),
            rows.geometry[i].copy(),
        )
        for i in range(int(rows.size[0]))
    }


def assert_consistent(evidence: Evidence) -> None:
    """Every row is on the list of exactly one cluster that exists, and all counts agree."""
    rows, clusters = evidence.rows, evidence.clusters
    n, existing = int(rows.size[0]), int(clusters.size[0])
    seen = np.zeros(n, np.int64)
    for c in range(existing):
        row, before, length = int(clusters.head[c]), -1, 0
        hits = []
        while row != -1:
            assert rows.owner[row] == c
            assert rows.before[row] == before
            seen[row] += 1
            length += 1
            if rows.kind[row] == POINT:
                hits.append(row)
            before, row = row, int(rows.after[row])
        assert length == clusters.rows[c]
        assert clusters.moments[c, 0] == len(hits)
    assert (seen == 1).all()
    assert not clusters.rows[existing:].any()
    keys = rows.keys[:n]
    assert len(np.unique(keys, axis=0)) == n
    assert (rows.count[:n] > 0.0).all()
