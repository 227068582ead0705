"""Calibration over the whole committee, by leaving out one raw observation at a time.

An expert's observation may stand for many raw ones at the same place. Leaving one of n out leaves
n - 1 there, in closed form: the expert's latent value without the place, times the likelihood of
the n - 1, times what the other experts say.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpom_core.calibration import Calibration, fit
from gpom_core.committee import Fusion
from gpom_core.snapshot import Snapshot

SAMPLES = 2000  # the slope's standard error is then below 3 %
_SEED = 20220918


def recalibrated(snapshot: Snapshot, samples: int = SAMPLES) -> Calibration:
    """The calibration of highest leave-one-out likelihood, that of `snapshot` if it is empty.

    The offset stays 0: unknown space is as likely free as occupied.
    """
    if not snapshot.members:
        return snapshot.calibration
    mean, variance, occupied = leave_one_out(snapshot, samples)
    return fit(mean, variance, occupied, with_offset=False, start=snapshot.calibration)


def leave_one_out(
    snapshot: Snapshot, samples: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Latent mean, variance and truth (samples,) of raw observations that were left out.

    Observations are drawn as a beam makes them: half of them hits, half of them places along the
    free part of a beam. The draw is seeded: the same map gives the same calibration.
    """
    experts = [member.expert for _, member in sorted(snapshot.members.items())]
    place = np.concatenate([e.observations.geometry.mean(axis=1) for e in experts])
    target = np.concatenate([e.observations.targets for e in experts])
    count = np.concatenate([e.observations.count for e in experts])
    noise = np.concatenate([e.observations.noise_variance for e in experts])
    weight = np.concatenate([e.weights for e in experts])
    precision = np.concatenate([np.diagonal(e.precision) for e in experts])
    prior = snapshot.prior_variance

    hit = target > 0
    share = np.where(hit, count / max(count[hit].sum(), 1e-9), count / max(count[~hit].sum(), 1e-9))
    drawn = np.random.default_rng(_SEED).choice(len(share), size=samples, p=share / share.sum())
    place, target, count = place[drawn], target[drawn], count[drawn]
    noise, weight, precision = noise[drawn], weight[drawn], precision[drawn]

    within_mean = target - noise * weight
    within_variance = np.clip(noise - noise**2 * precision, 1e-9, prior)
    without_mean = target - weight / precision
    without_variance = np.clip(1.0 / precision - noise, 1e-9, prior)
    # The n - 1 that stay; beyond the cap of the noise more of them weigh no more.
    remaining = np.maximum(1.0 - 1.0 / np.maximum(count, 1.0), 0.0) / noise
    left_precision = 1.0 / without_variance + remaining
    left_information = without_mean / without_variance + remaining * target

    all_precision, all_information = snapshot.sums(place, Fusion.BCM)
    others = np.maximum(all_precision - (1.0 / within_variance - 1.0 / prior), 1.0 / prior)
    committee = others + left_precision - 1.0 / prior
    information = all_information - within_mean / within_variance + left_information
    return information / committee, 1.0 / committee, target > 0
