"""Median and quantiles are numpy's, to the last bit."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kiteline_core.order_statistics import median, quantiles

numbers = arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e6, 1e6, allow_subnormal=False))


@given(numbers)
def test_median(values: np.ndarray) -> None:
    assert median(values) == float(np.median(values))


@given(numbers, st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4))
def test_quantiles(values: np.ndarray, shares: list[float]) -> None:
    found = quantiles(values, tuple(shares))
    assert found == tuple(np.quantile(values, shares).tolist())
