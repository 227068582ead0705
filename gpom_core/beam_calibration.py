"""Calibration of a mixture by leaving out one beam at a time.

A beam's hit and its free line stand or fall together: with one left out, the other still gives
its answer away. Leaving out a set S of an expert's observations is closed form, with P = K^-1 and
q = P k(x):

    mean = k(x)' alpha - q_S' P_SS^-1 alpha_S
    variance = k(x, x) - k(x)' q + q_S' P_SS^-1 q_S

For one observation this is the leave-one-out of Rasmussen & Williams, section 5.4.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gpom_core.calibration import Calibration, fit
from gpom_core.mixture import Beams, Cluster, Mixture, add_opinion, predict

_Floats = NDArray[np.float64]


def calibrated(
    mixture: Mixture, clusters: Sequence[Cluster], beams: Beams, seed: int = 0
) -> Mixture:
    """The same mixture with the calibration of highest leave-one-beam-out likelihood."""
    return mixture.with_fusion(mixture.fusion, calibration_of(mixture, clusters, beams, seed))


def calibration_of(
    mixture: Mixture, clusters: Sequence[Cluster], beams: Beams, seed: int = 0
) -> Calibration:
    """Slope of highest leave-one-beam-out likelihood; unknown space stays at one half."""
    return fit(*leave_one_beam_out(mixture, clusters, beams, seed), with_offset=False)


def leave_one_beam_out(
    mixture: Mixture, clusters: Sequence[Cluster], beams: Beams, seed: int = 0
) -> tuple[_Floats, _Floats, NDArray[np.bool_]]:
    """Latent mean, variance and truth at each hit and at one place on each beam, itself left out.

    Args:
        clusters: that the experts were trained on, in their order.
        seed: of the places, uniform along the free part of a beam.

    Returns:
        (n,) each, for n hits and beams.
    """
    share = np.random.default_rng(seed).random((len(beams.returned), 1))
    inside = beams.origin + share * (beams.end - beams.origin)
    means, variances, truth = [np.empty(0)], [np.empty(0)], [np.empty(0, np.bool_)]
    for e, cluster in enumerate(clusters):
        own = np.unique(cluster.beam)
        hit = own[beams.returned[own]]
        points = np.concatenate([beams.end[hit], inside[own]])
        precision, information = mixture.sums(points)
        expert = mixture.experts[e]
        prior = expert.hyperparameters.signal_std**2
        which, fusion = np.arange(len(points)), int(mixture.fusion)
        for sign, opinion in (
            (-1.0, predict(expert, points, mixture.cross)),
            (1.0, _without(mixture, e, cluster, points, np.concatenate([hit, own]))),
        ):
            p, i = np.zeros(len(points)), np.zeros(len(points))
            add_opinion(fusion, *opinion, prior, which, p, i)
            precision += sign * p
            information += sign * i
        precision = np.maximum(precision, 0.5 / mixture.prior_variance)
        means.append(information / precision)
        variances.append(1.0 / precision)
        truth.append(which < len(hit))
    return np.concatenate(means), np.concatenate(variances), np.concatenate(truth)


def _without(
    mixture: Mixture, e: int, cluster: Cluster, points: _Floats, beam: NDArray[np.int64]
) -> tuple[_Floats, _Floats]:
    """Mean and variance (n,) of expert e at points (n, 2), each without one beam (n,)."""
    expert = mixture.experts[e]
    h, o = expert.hyperparameters, expert.observations
    signal = h.signal_std**2
    k = signal * mixture.cross(o.kinds, o.geometry, points, h.length_scale_m)
    precision = expert.precision
    q = k @ precision
    mean, variance = k @ expert.weights, signal - np.einsum("ij,ij->i", q, k)
    for j, b in enumerate(beam):
        left_out = np.flatnonzero(cluster.beam == b)
        block = precision[np.ix_(left_out, left_out)]
        both = np.linalg.solve(block, np.stack([expert.weights[left_out], q[j, left_out]], axis=1))
        mean[j] -= q[j, left_out] @ both[:, 0]
        variance[j] += q[j, left_out] @ both[:, 1]
    return mean, np.clip(variance, 1e-9 * signal, signal)
