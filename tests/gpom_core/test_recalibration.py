"""Calibration leaves raw observations out: the closed form is what refitting gives."""

from dataclasses import replace

import numpy as np
import pytest

from gpom_core.calibration import Calibration
from gpom_core.committee import fuse
from gpom_core.expert import Hyperparameters, train
from gpom_core.mapper import Mapper, TrainedExpert
from gpom_core.observations import Observations
from gpom_core.recalibration import leave_one_out, recalibrated
from gpom_core.snapshot import Snapshot
from tests.gpom_core.synthetic import points_observed, posterior, tour, without

HYPERPARAMETERS = Hyperparameters(0.4, 1.0)
RAW_NOISE = 0.3


def some_places(seed: int, x: float) -> Observations:
    """Places seen one to six times: a wall, and what is free before it."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((x, -1.0), (x + 1.0, 0.0), (12, 2))
    count = rng.integers(1, 7, 12).astype(float)
    return points_observed(xy, np.where(xy[:, 1] > -0.4, 1.0, -1.0), RAW_NOISE / count, count)


def committee(*experts: Observations) -> Snapshot:
    line = np.zeros((2, 2))
    members = [TrainedExpert(i, 1, train(o, HYPERPARAMETERS), line) for i, o in enumerate(experts)]
    return Snapshot().swapped(members)


def seen_once_less(o: Observations, i: int) -> Observations:
    """The observations without one of the raw ones behind number `i`."""
    if o.count[i] == 1.0:
        return without(o, i)
    count = o.count.copy()
    count[i] -= 1.0
    return replace(o, count=count, noise_variance=RAW_NOISE / count)


def test_leaving_out_a_raw_observation_is_refitting_without_it() -> None:
    experts = [some_places(0, 0.0), some_places(1, 0.7)]
    expected = {}
    for e, observations in enumerate(experts):
        for i in range(len(observations)):
            fewer = [seen_once_less(o, i) if k == e else o for k, o in enumerate(experts)]
            place = observations.geometry[i, :1]
            opinions = [posterior(train(o, HYPERPARAMETERS), place) for o in fewer]
            means, variances = (np.array(part) for part in zip(*opinions, strict=True))
            mean, variance = fuse(means, variances, 1.0)
            expected[e, i] = float(mean[0]), float(variance[0]), bool(observations.targets[i] > 0)

    drawn = leave_one_out(committee(*experts), samples=600)
    met = set()
    for mean, variance, occupied in zip(*drawn, strict=True):
        key = min(
            expected, key=lambda k: abs(expected[k][0] - mean) + abs(expected[k][1] - variance)
        )
        assert mean == pytest.approx(expected[key][0], abs=2e-3)
        assert variance == pytest.approx(expected[key][1], abs=2e-3)
        assert occupied == expected[key][2]
        met.add(key)
    assert len(met) == len(expected)


def test_hits_and_free_space_are_drawn_half_and_half() -> None:
    wall = points_observed([[0.0, 0.0], [0.5, 0.0]], [1.0, 1.0], 0.1)
    room = points_observed(
        np.random.default_rng(0).uniform(-3.0, -1.0, (40, 2)), np.full(40, -1.0), 0.1, 7.0
    )
    *_, occupied = leave_one_out(committee(wall, room), samples=2000)
    assert occupied.mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("target", [1.0, -1.0])
def test_a_map_of_one_kind_of_evidence_can_be_calibrated(target: float) -> None:
    snapshot = committee(points_observed([[0.0, 0.0], [0.1, 0.0]], [target] * 2))
    found = recalibrated(snapshot)
    assert found.offset == 0.0
    assert 0.05 <= found.slope <= 50.0


def test_an_empty_map_keeps_its_calibration() -> None:
    assert recalibrated(Snapshot(calibration=Calibration(2.2))) == Calibration(2.2)


def test_the_same_map_is_calibrated_the_same() -> None:
    mapper = Mapper()
    for scan in tour(4):
        mapper.update(scan)
    snapshot = mapper.train()
    assert recalibrated(snapshot) == recalibrated(snapshot)
    assert recalibrated(snapshot).slope == pytest.approx(snapshot.calibration.slope, rel=0.03)
