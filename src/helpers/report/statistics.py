"""What several runs, one a seed, say: the interval of their median, and the interval in which one more run would lie."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

LEVEL = 0.95
FEWEST = 5  # values for an interval of the median: the range of fewer holds the true median less than 94 times in a hundred
RESAMPLES = 9999


def median_interval(values: ArrayLike) -> NDArray[np.float64]:
    """The 95 % bootstrap interval of the median, by percentiles of resampled medians; the runs last.

    The BCa correction is left out: its jackknife is not valid for a median. The resamples are the same at every call. Of finite
    values, shape (..., n), lower and upper end, shape (..., 2); nan for fewer than `FEWEST`.
    """
    runs = np.asarray(values, dtype=float)
    if runs.shape[-1] < FEWEST:
        return np.full((*runs.shape[:-1], 2), np.nan)
    batch = max(1, 2_000_000 // runs.size)  # bounds the memory
    resampling = {"n_resamples": RESAMPLES, "batch": batch, "rng": np.random.default_rng(0)}
    found = stats.bootstrap((runs,), np.median, axis=-1, confidence_level=LEVEL, method="percentile", **resampling)
    return np.stack(found.confidence_interval, axis=-1)


def prediction_interval(values: ArrayLike, sampling_variance: float = 0.0) -> tuple[float, float]:
    """The 95 % prediction interval for one more run: mean -/+ t sqrt(s^2 (1 + 1/n) + sampling variance).

    Student's t, because n runs cannot show a 2.5 % quantile: their range holds one more run with probability (n - 1)/(n + 1) only.
    Where one more run has a known sampling variance beyond these, the degrees of freedom are those of Welch and Satterthwaite.
    Of one value a run, shape (n,), lower and upper end; nan for fewer than two.
    """
    runs = np.asarray(values, dtype=float)
    if len(runs) < 2:
        return np.nan, np.nan
    between = runs.var(ddof=1) * (1 + 1 / len(runs))
    total = between + sampling_variance
    freedom = (len(runs) - 1) * (total / between) ** 2 if between > 0 else np.inf
    reach = stats.t.ppf((1 + LEVEL) / 2, freedom) * np.sqrt(total)
    return float(runs.mean() - reach), float(runs.mean() + reach)
