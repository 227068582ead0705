"""Fusion rules: what one expert, none, and many of them come to."""

import numpy as np
import pytest

from gpom_core.committee import Fusion, contribution, fuse, prior_precision
from gpom_core.errors import InvalidQueryError

PRIOR = 1.7
MEAN = np.array([[0.8, -0.3, 0.0]])
VARIANCE = np.array([[0.2, 1.1, 1.7]])


def test_a_committee_of_one_is_its_expert() -> None:
    mean, variance = fuse(MEAN, VARIANCE, PRIOR, Fusion.BCM)
    np.testing.assert_allclose(mean, MEAN[0])
    np.testing.assert_allclose(variance, VARIANCE[0])


def test_a_product_of_one_expert_is_that_expert() -> None:
    mean, variance = fuse(MEAN, VARIANCE, PRIOR, Fusion.POE)
    np.testing.assert_allclose(mean, MEAN[0])
    np.testing.assert_allclose(variance, VARIANCE[0])


def test_the_product_of_experts_is_the_sum_of_their_precisions() -> None:
    means, variances = np.array([[1.0], [-0.5], [0.0]]), np.array([[0.3], [0.9], [PRIOR]])
    mean, variance = fuse(means, variances, PRIOR, Fusion.POE)
    np.testing.assert_allclose(variance, 1.0 / (1.0 / variances).sum(axis=0))
    np.testing.assert_allclose(mean, variance * (means / variances).sum(axis=0))


def test_the_bayesian_committee_counts_the_prior_once() -> None:
    means, variances = np.array([[1.0], [-0.5]]), np.array([[0.3], [0.9]])
    mean, variance = fuse(means, variances, PRIOR, Fusion.BCM)
    precision = 1 / 0.3 + 1 / 0.9 - 1 / PRIOR
    np.testing.assert_allclose(variance, 1.0 / precision)
    np.testing.assert_allclose(mean, (1.0 / 0.3 - 0.5 / 0.9) / precision)


def test_robust_weights_are_the_fall_of_the_entropy() -> None:
    weight = 0.5 * np.log(PRIOR / 0.2)
    precision, information = contribution(Fusion.RBCM, 0.8, 0.2, PRIOR)
    np.testing.assert_allclose(precision, weight * (1 / 0.2 - 1 / PRIOR))
    np.testing.assert_allclose(information, weight * 0.8 / 0.2)


@pytest.mark.parametrize("fusion", list(Fusion))
def test_who_knows_nothing_contributes_nothing(fusion: Fusion) -> None:
    assert contribution(fusion, 0.0, PRIOR, PRIOR) == (0.0, 0.0)


@pytest.mark.parametrize("fusion", list(Fusion))
def test_without_experts_there_is_the_prior(fusion: Fusion) -> None:
    assert prior_precision(fusion, PRIOR, 0) == 1.0 / PRIOR


def test_only_the_product_grows_certain_where_nobody_knows() -> None:
    far = np.zeros((100, 1)), np.full((100, 1), PRIOR)
    assert fuse(*far, PRIOR, Fusion.BCM)[1] == pytest.approx(PRIOR)
    assert fuse(*far, PRIOR, Fusion.RBCM)[1] == pytest.approx(PRIOR)
    assert fuse(*far, PRIOR, Fusion.POE)[1] == pytest.approx(PRIOR / 100)


def test_opinions_of_different_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"must both be \(k, m\)"):
        fuse(np.zeros((2, 3)), np.ones((3, 2)), PRIOR)


@pytest.mark.parametrize("rule", list(Fusion))
def test_rules_have_names(rule: Fusion) -> None:
    assert Fusion.named(rule.name.lower()) is rule


@pytest.mark.parametrize("name", ["", "mean", "bcm ", None, 0])
def test_an_unknown_rule_is_refused_with_those_that_exist(name: object) -> None:
    with pytest.raises(InvalidQueryError, match="use one of bcm, rbcm, poe"):
        Fusion.named(name)  # type: ignore[arg-type]
