"""Laws of committees: sums, whatever the order of their experts and wherever these live."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gpom_core.committee import Fusion, contribution, fuse, prior_precision

PRIOR = 1.3
ADDITIVE = [Fusion.BCM, Fusion.RBCM]


@st.composite
def opinions(draw: st.DrawFn, most: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances, (k, m); no expert knows less than the prior."""
    shape = draw(st.tuples(st.integers(1, most), st.integers(1, 4)))
    means = draw(arrays.arrays(np.float64, shape, elements=st.floats(-2.0, 2.0)))
    variances = draw(arrays.arrays(np.float64, shape, elements=st.floats(0.01, PRIOR)))
    return means, variances


def sums(means: np.ndarray, variances: np.ndarray, fusion: Fusion) -> tuple[float, float]:
    """Precision and information that experts add at one point."""
    parts = [contribution(fusion, m, v, PRIOR) for m, v in zip(means, variances, strict=True)]
    return sum(p for p, _ in parts), sum(i for _, i in parts)


@pytest.mark.parametrize("fusion", list(Fusion))
@given(opinions(), st.randoms(use_true_random=False))
def test_the_order_of_experts_does_not_matter(fusion, opinion, random) -> None:
    means, variances = opinion
    order = list(range(len(means)))
    random.shuffle(order)
    for got, expected in zip(
        fuse(means[order], variances[order], PRIOR, fusion),
        fuse(means, variances, PRIOR, fusion),
        strict=True,
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("fusion", ADDITIVE)
@given(opinions(), st.data())
def test_shards_of_a_committee_are_a_committee(fusion, opinion, data) -> None:
    means, variances = opinion
    shard = np.array(
        data.draw(st.lists(st.integers(0, 2), min_size=len(means), max_size=len(means)))
    )
    mean, variance = fuse(means, variances, PRIOR, fusion)
    for j in range(means.shape[1]):
        parts = [sums(means[shard == s, j], variances[shard == s, j], fusion) for s in range(3)]
        precision = prior_precision(fusion, PRIOR, len(means)) + sum(p for p, _ in parts)
        information = sum(i for _, i in parts)
        np.testing.assert_allclose(1.0 / precision, variance[j], rtol=1e-9)
        np.testing.assert_allclose(information / precision, mean[j], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("fusion", ADDITIVE)
@given(opinions(), st.integers(1, 50))
def test_experts_that_know_nothing_change_nothing(fusion, opinion, strangers: int) -> None:
    means, variances = opinion
    shape = (strangers, means.shape[1])
    more = (
        np.concatenate([means, np.zeros(shape)]),
        np.concatenate([variances, np.full(shape, PRIOR)]),
    )
    for got, expected in zip(
        fuse(*more, PRIOR, fusion), fuse(means, variances, PRIOR, fusion), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("fusion", ADDITIVE)
@given(opinions())
def test_a_committee_never_knows_less_than_nobody(fusion, opinion) -> None:
    _, variance = fuse(*opinion, PRIOR, fusion)
    assert (variance > 0.0).all()
    assert (variance <= PRIOR * (1.0 + 1e-12)).all()


@given(opinions())
def test_a_committee_knows_at_least_what_its_best_expert_knows(opinion) -> None:
    _, variance = fuse(*opinion, PRIOR, Fusion.BCM)
    assert (variance <= opinion[1].min(axis=0) * (1.0 + 1e-12)).all()


@given(opinions(), opinions())
def test_replacing_an_expert_is_subtracting_the_old_and_adding_the_new(old, new) -> None:
    before = sums(old[0][:, 0], old[1][:, 0], Fusion.BCM)
    minus = contribution(Fusion.BCM, old[0][0, 0], old[1][0, 0], PRIOR)
    plus = contribution(Fusion.BCM, new[0][0, 0], new[1][0, 0], PRIOR)
    swapped = old[0][:, 0].copy(), old[1][:, 0].copy()
    swapped[0][0], swapped[1][0] = new[0][0, 0], new[1][0, 0]
    expected = sums(*swapped, Fusion.BCM)
    for i in range(2):
        np.testing.assert_allclose(before[i] - minus[i] + plus[i], expected[i], atol=1e-7)
