"""Random draws against their probabilities, at five standard errors."""

from typing import Any

import jax
import numpy as np

KEYS = jax.random.split(jax.random.key(7), 2000)


def assert_frequency(count: Any, p: float, draws: int) -> None:
    """``count`` of ``draws`` independent draws is what probability p gives."""
    assert abs(int(count) - draws * p) <= 5 * np.sqrt(draws * p * (1 - p)) + 1e-9
