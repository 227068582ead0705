"""Dirichlet process clustering of points by a collapsed Gibbs sampler (eq. 1-4 of Kim & Kim).

Every cluster is a Gaussian whose mean and covariance have a normal-inverse-Wishart prior and are
integrated out, so that only the labels are sampled (Neal, "Markov chain sampling methods for
Dirichlet process mixture models", 2000, algorithm 3). A point joins a cluster of m others with
probability proportional to m times the cluster's predictive density there, a multivariate Student
t, and begins a new one in proportion to the concentration times the prior's predictive density.
The number of clusters is not given; it comes out.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log, pi

import numpy as np
from numpy.typing import NDArray

from gpom_core.errors import ConfigurationError
from gpom_core.jit import compiled

_Floats = NDArray[np.float64]
_Labels = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class NormalInverseWishart:
    """Prior of a cluster's mean and covariance, in d dimensions (Murphy 2007, section 8).

    Attributes:
        mean_m: (d,) where clusters are.
        strength: how many points the prior of the mean is worth.
        degrees: of freedom, more than d - 1; how many points the prior of the scatter is worth.
        scatter_m2: (d, d) symmetric positive definite; the expected covariance of a cluster is
            scatter / (degrees - d - 1).

    Raises:
        ConfigurationError: shapes do not fit together or a value is out of range.
    """

    mean_m: _Floats
    strength: float
    degrees: float
    scatter_m2: _Floats

    def __post_init__(self) -> None:
        d = len(self.mean_m)
        if self.scatter_m2.shape != (d, d):
            raise ConfigurationError(
                f"scatter_m2 has shape {self.scatter_m2.shape}, expected ({d}, {d}) as mean_m has"
            )
        if self.strength <= 0.0 or self.degrees <= d - 1.0:
            raise ConfigurationError(
                f"strength is {self.strength} and degrees {self.degrees}, "
                f"expected more than 0 and more than {d - 1}"
            )
        if not (np.linalg.eigvalsh(self.scatter_m2) > 0.0).all():
            raise ConfigurationError("scatter_m2 is not positive definite")

    @classmethod
    def around(cls, points_m: _Floats, extent_m: float) -> NormalInverseWishart:
        """A weak prior for clusters of about `extent_m` (standard deviation) among points (n, d).

        The mean is that of the points, and its strength makes clusters spread as the points do.
        """
        d = points_m.shape[1]
        degrees = d + 2.0  # the least with an expected covariance, then equal to the scatter
        spread2 = max(float(points_m.var(axis=0).mean()), extent_m**2)
        return cls(
            mean_m=points_m.mean(axis=0),
            strength=extent_m**2 / spread2,
            degrees=degrees,
            scatter_m2=np.eye(d) * extent_m**2,
        )


def sample_clusters(
    points_m: _Floats,
    prior: NormalInverseWishart,
    *,
    concentration: float = 1.0,
    sweeps: int = 100,
    seed: int = 0,
) -> tuple[_Labels, _Floats]:
    """Cluster points: the most probable of the sampled partitions.

    Args:
        points_m: (n, d). prior: of each cluster.
        concentration: of the Dirichlet process; the more, the more clusters.
        sweeps: how often every point is drawn anew.
        seed: of the sampler.

    Returns:
        (n,) labels 0, 1, …, in order of appearance, and (sweeps,) the log of the joint density of
        points and partition after each sweep.

    Raises:
        ConfigurationError: a value is out of range or shapes do not fit together.
    """
    if points_m.ndim != 2 or points_m.shape[1] != len(prior.mean_m):
        raise ConfigurationError(
            f"points have shape {points_m.shape}, expected (n, {len(prior.mean_m)})"
        )
    if concentration <= 0.0 or sweeps < 1:
        raise ConfigurationError(
            f"concentration is {concentration} and sweeps {sweeps}, "
            "expected more than 0 and at least 1"
        )
    rng = np.random.default_rng(seed)
    n, d = points_m.shape
    order = np.array([rng.permutation(n) for _ in range(sweeps)], np.int64).reshape(sweeps, n)
    # Relative to the prior's mean the moments keep their digits far from the origin.
    centred = np.ascontiguousarray(points_m - prior.mean_m, np.float64)
    labels, history = _gibbs(
        centred, np.ascontiguousarray(prior.scatter_m2, np.float64), prior.strength, prior.degrees,
        concentration, order, rng.random((sweeps, n)), _student_table(n, d, prior.degrees),
    )  # fmt: skip
    return _in_order(labels), history


def log_joint(points_m: _Floats, labels: _Labels, prior: NormalInverseWishart,
              concentration: float = 1.0) -> float:  # fmt: skip
    """Log density of points (n, d) and a partition (n,), as a product of predictive densities."""
    centred = np.ascontiguousarray(points_m - prior.mean_m, np.float64)
    table = _student_table(len(points_m), points_m.shape[1], prior.degrees)
    scatter = np.ascontiguousarray(prior.scatter_m2, np.float64)
    ordered = _in_order(np.asarray(labels, np.int64))
    return float(_log_joint(
        centred, ordered, scatter, prior.strength, prior.degrees, concentration, table
    ))  # fmt: skip


def _student_table(n: int, d: int, degrees: float) -> _Floats:
    """Constant of the Student t of clusters with 0 to n points, (n + 1,).

    log Gamma((f + d) / 2) - log Gamma(f / 2) - d / 2 log(pi), f = degrees + m - d + 1.
    """
    f = degrees - d + 1.0 + np.arange(n + 1)
    gamma = [lgamma((v + d) / 2.0) - lgamma(v / 2.0) for v in f]
    return np.array(gamma, np.float64) - 0.5 * d * log(pi)


def _in_order(labels: _Labels) -> _Labels:
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


@compiled
def _predictive(
    x: _Floats, m: float, total: _Floats, squares: _Floats, scatter: _Floats,
    strength: float, degrees: float, constant: float, work: _Floats,
) -> float:  # fmt: skip
    """Log density of x (d,) given a cluster of m points with these sums; a Student t.

    Args:
        total: (d,) sum of its points. squares: (d, d) sum of their outer products.
        constant: `_student_table` of m. work: (d, d + 1) scratch.
    """
    d = len(x)
    k = strength + m
    freedom = degrees + m - d + 1.0
    scale = (k + 1.0) / k  # the scatter times this, over the degrees of freedom, is the t's scale
    for a in range(d):
        for b in range(a + 1):
            work[a, b] = scale * (scatter[a, b] + squares[a, b] - total[a] * total[b] / k)
        work[a, d] = x[a] - total[a] / k
    log_determinant, distance2 = 0.0, 0.0
    for a in range(d):  # Cholesky and forward substitution in one
        for b in range(a + 1):
            value = work[a, b]
            for c in range(b):
                value -= work[a, c] * work[b, c]
            work[a, b] = np.sqrt(value) if a == b else value / work[b, b]
        z = work[a, d]
        for c in range(a):
            z -= work[a, c] * work[c, d]
        work[a, d] = z / work[a, a]
        log_determinant += np.log(work[a, a])
        distance2 += work[a, d] * work[a, d]
    density: float = constant - log_determinant - 0.5 * (freedom + d) * np.log1p(distance2)
    return density


@compiled
def _move(
    sign: float, x: _Floats, count: _Floats, total: _Floats, squares: _Floats, k: int
) -> None:
    """Put a point into cluster k (sign 1) or take it out (sign -1)."""
    count[k] += sign
    for a in range(len(x)):
        total[k, a] += sign * x[a]
        for b in range(len(x)):
            squares[k, a, b] += sign * x[a] * x[b]


@compiled
def _gibbs(
    x: _Floats, scatter: _Floats, strength: float, degrees: float, concentration: float,
    order: _Labels, uniform: _Floats, table: _Floats,
) -> tuple[_Labels, _Floats]:  # fmt: skip
    n, d = x.shape
    labels = np.zeros(n, np.int64)  # all in one cluster; clusters split off quickly
    count, total = np.zeros(n + 1), np.zeros((n + 1, d))
    squares, work = np.zeros((n + 1, d, d)), np.empty((d, d + 1))
    for i in range(n):
        _move(1.0, x[i], count, total, squares, 0)
    used = 1
    weight = np.empty(n + 1)
    best, history = labels.copy(), np.empty(len(order))
    highest = -np.inf
    for sweep in range(len(order)):
        for step in range(n):
            i = order[sweep, step]
            _move(-1.0, x[i], count, total, squares, labels[i])
            if count[labels[i]] < 0.5:  # the last cluster takes the place of an empty one
                used -= 1
                gone = labels[i]
                count[gone], total[gone], squares[gone] = count[used], total[used], squares[used]
                for j in range(n):
                    if labels[j] == used:
                        labels[j] = gone
            count[used], total[used], squares[used] = 0.0, 0.0, 0.0
            top = -np.inf
            for k in range(used + 1):
                size = count[k] if k < used else concentration
                weight[k] = np.log(size) + _predictive(
                    x[i], count[k], total[k], squares[k], scatter, strength, degrees,
                    table[int(count[k] + 0.5)], work,
                )  # fmt: skip
                top = max(top, weight[k])
            mass = 0.0
            for k in range(used + 1):
                mass += np.exp(weight[k] - top)
            left = uniform[sweep, step] * mass
            chosen = 0
            while chosen < used:
                left -= np.exp(weight[chosen] - top)
                if left < 0.0:
                    break
                chosen += 1
            labels[i] = chosen
            used = max(used, chosen + 1)
            _move(1.0, x[i], count, total, squares, chosen)
        history[sweep] = _log_joint(x, labels, scatter, strength, degrees, concentration, table)
        if history[sweep] > highest:
            highest = history[sweep]
            best[:] = labels
    return best, history


@compiled
def _log_joint(
    x: _Floats, labels: _Labels, scatter: _Floats, strength: float, degrees: float,
    concentration: float, table: _Floats,
) -> float:  # fmt: skip
    """Points arrive one by one: the Chinese restaurant process times the predictive densities."""
    n, d = x.shape
    count, total = np.zeros(n + 1), np.zeros((n + 1, d))
    squares, work = np.zeros((n + 1, d, d)), np.empty((d, d + 1))
    value = 0.0
    for i in range(n):
        k = labels[i]
        share = count[k] if count[k] > 0.5 else concentration
        value += np.log(share / (i + concentration)) + _predictive(
            x[i], count[k], total[k], squares[k], scatter, strength, degrees,
            table[int(count[k] + 0.5)], work,
        )  # fmt: skip
        _move(1.0, x[i], count, total, squares, k)
    return value
