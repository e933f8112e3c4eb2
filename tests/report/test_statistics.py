"""Intervals over runs, against exact distributions, a table of t and simulated runs."""

import warnings

import numpy as np
import pytest
from scipy.stats import binom

from helpers.report.statistics import FEWEST, median_interval, prediction_interval


@pytest.mark.parametrize("n_runs", [5, 9, 21])
def test_the_interval_of_the_median_is_that_of_the_exact_bootstrap(n_runs):
    """The median of an odd number of draws from n values is at most the k-th smallest if more than half of the draws are."""
    values = np.random.default_rng(n_runs).normal(3, 2, n_runs)
    at_most = binom.sf((n_runs - 1) / 2, n_runs, np.arange(1, n_runs + 1) / n_runs)
    low, high = np.sort(values)[np.searchsorted(at_most, [0.025, 0.975])]
    np.testing.assert_allclose(median_interval(values), [low, high], rtol=1e-12)


def test_many_rows_at_once_are_each_row_alone_and_too_few_runs_give_no_interval_of_the_median():
    rows = np.random.default_rng(0).normal(size=(7, 6))
    np.testing.assert_array_equal(median_interval(rows), [median_interval(row) for row in rows])
    assert np.isnan(median_interval(np.ones((3, FEWEST - 1)))).all()
    assert np.isfinite(median_interval(np.arange(FEWEST))).all()


def test_runs_that_are_all_alike_have_intervals_without_width_and_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert median_interval(np.full(20, 0.3)).tolist() == [0.3, 0.3]
        assert prediction_interval(np.full(4, 2.0)) == (2.0, 2.0)
        # Then all that is left is the known variance, and its normal distribution.
        assert prediction_interval(np.full(4, 2.0), 0.25) == pytest.approx((2 - 1.959964 / 2, 2 + 1.959964 / 2), abs=1e-6)


def test_the_prediction_interval_by_hand():
    """Mean 3, s^2 = 2.5; the 97.5 % point of t with four degrees of freedom is 2.776445."""
    reach = 2.776445 * (2.5 * 1.2) ** 0.5
    assert prediction_interval([1, 2, 3, 4, 5]) == pytest.approx((3 - reach, 3 + reach), rel=1e-6)
    assert np.isnan(prediction_interval([1.0])).all()


@pytest.mark.parametrize("noise", [0.0, 0.5, 3.0])
def test_one_more_run_lies_in_the_prediction_interval_19_times_in_20(noise):
    """Runs that scatter by 1, measured exactly; the further run is measured with noise of known size."""
    generator, n_repeats = np.random.default_rng(1), 3000
    inside = 0
    for runs in generator.normal(size=(n_repeats, 6)):
        low, high = prediction_interval(runs, noise**2)
        inside += low <= generator.normal() + noise * generator.normal() <= high
    assert inside / n_repeats == pytest.approx(0.95, abs=4 * (0.95 * 0.05 / n_repeats) ** 0.5)
