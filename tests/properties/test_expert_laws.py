"""Laws of experts, over observations of every kind at once."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gpom_core.expert import Hyperparameters, train
from gpom_core.kernels import gram
from gpom_core.observations import Observations
from gpom_core.rows import BOX, POINT
from tests.gpom_core.synthetic import both, points_observed, posterior, without

coordinates = st.floats(-2.0, 2.0)
places = st.tuples(coordinates, coordinates)


@st.composite
def observations(draw: st.DrawFn, least: int = 1) -> Observations:
    """Points, segments and boxes with targets as they come and any noise."""
    n = draw(st.integers(least, 8))
    kinds = np.array(draw(st.lists(st.integers(0, 2), min_size=n, max_size=n)), np.uint8)
    geometry = np.array(draw(st.lists(st.tuples(places, places), min_size=n, max_size=n)))
    geometry[kinds == POINT, 1] = geometry[kinds == POINT, 0]
    geometry[kinds == BOX] = np.sort(geometry[kinds == BOX], axis=1)
    noise = draw(st.lists(st.floats(0.02, 5.0), min_size=n, max_size=n))
    targets = np.where(kinds == POINT, 1.0, -1.0)
    return Observations(kinds, geometry, targets, np.array(noise), np.ones(n))


hyperparameters = st.builds(
    Hyperparameters,
    st.floats(0.1, 2.0),
    st.floats(0.5, 2.0),
    st.floats(0.5, 2.0),
    st.floats(0.5, 2.0),
)
asked = st.lists(places, min_size=1, max_size=6).map(np.array)


@given(observations(), hyperparameters, asked)
def test_evidence_never_makes_an_expert_less_sure_than_the_prior(o, h, points) -> None:
    _, variance = posterior(train(o, h), points)
    assert (variance <= h.signal_std**2 * (1.0 + 1e-9)).all()
    assert (variance > -1e-7).all()


@given(observations(least=2), hyperparameters, asked)
def test_more_evidence_never_makes_an_expert_less_sure(o, h, points) -> None:
    _, fewer = posterior(train(without(o, 0), h), points)
    _, more = posterior(train(o, h), points)
    assert (more <= fewer + 1e-7).all()


@given(observations(), hyperparameters, asked, st.integers(2, 9), st.data())
def test_n_equal_observations_are_one_with_an_nth_of_the_noise(o, h, points, n, data) -> None:
    i = data.draw(st.integers(0, len(o) - 1))
    noise = o.noise_variance.copy()
    noise[i] /= n
    merged = replace(o, noise_variance=noise)
    one = without(o, i)
    copies = Observations(
        *(
            np.repeat(getattr(o, name)[i : i + 1], n, axis=0)
            for name in ("kinds", "geometry", "targets", "noise_variance", "count")
        )
    )
    many = both(one, copies)
    for got, expected in zip(
        posterior(train(merged, h), points), posterior(train(many, h), points), strict=True
    ):
        np.testing.assert_allclose(got, expected, atol=1e-6)


@given(observations(least=2), hyperparameters)
def test_leaving_one_out_is_training_without_it(o, h) -> None:
    mean, variance = train(o, h).leave_one_out()
    signal = h.signal_std**2
    k = signal * gram(o.kinds, o.geometry, h.length_scale_m)
    for i in range(len(o)):
        expert = train(without(o, i), h)
        to = k[i, np.arange(len(o)) != i]
        np.testing.assert_allclose(mean[i], to @ expert.weights, atol=1e-6)
        expected = k[i, i] - to @ expert.precision @ to
        np.testing.assert_allclose(variance[i], np.clip(expected, 1e-9, signal), atol=1e-6)


@given(observations(), hyperparameters, asked, st.randoms(use_true_random=False))
def test_the_order_of_observations_does_not_matter(o, h, points, random) -> None:
    order = list(range(len(o)))
    random.shuffle(order)
    other = Observations(
        o.kinds[order], o.geometry[order], o.targets[order], o.noise_variance[order], o.count[order]
    )
    for got, expected in zip(
        posterior(train(other, h), points), posterior(train(o, h), points), strict=True
    ):
        np.testing.assert_allclose(got, expected, atol=1e-7)


@given(observations(), hyperparameters, asked)
def test_opposite_evidence_gives_the_opposite_mean(o, h, points) -> None:
    # The scale of the noise goes with the target: make it one for both.
    h = replace(h, free_noise_scale=h.hit_noise_scale)
    mean, variance = posterior(train(o, h), points)
    opposite, same = posterior(train(replace(o, targets=-o.targets), h), points)
    np.testing.assert_allclose(opposite, -mean, atol=1e-9)
    np.testing.assert_allclose(same, variance, atol=1e-9)


@given(observations(), hyperparameters)
def test_the_likelihood_is_that_of_a_normal_distribution(o, h) -> None:
    k = h.signal_std**2 * gram(o.kinds, o.geometry, h.length_scale_m)
    k += np.diag(h.noise_variance(o))
    fit = o.targets @ np.linalg.solve(k, o.targets)
    expected = -0.5 * (fit + np.linalg.slogdet(k)[1] + len(o) * np.log(2.0 * np.pi))
    np.testing.assert_allclose(train(o, h).log_likelihood, expected, rtol=1e-8)


@given(hyperparameters, st.floats(-1e6, 1e6), asked)
def test_where_an_expert_is_does_not_matter(h, shift: float, points) -> None:
    wall = points_observed(np.column_stack([np.linspace(-1, 1, 7), np.zeros(7)]), np.ones(7))
    away = replace(wall, geometry=wall.geometry + shift)
    for got, expected in zip(
        posterior(train(away, h), points + shift), posterior(train(wall, h), points), strict=True
    ):
        np.testing.assert_allclose(got, expected, atol=1e-6)
