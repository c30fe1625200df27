"""Array types, means of parts of a signal, and the number of threads of linear algebra."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
F = TypeVar("F", bound=Callable[..., Any])


def means(values: Array, starts: Integers) -> Array:
    """Return the mean of each part of a signal; the parts begin at the indices `starts`."""
    return np.asarray(np.add.reduceat(values, starts) / np.diff(np.append(starts, len(values))))


def single_threaded(function: F) -> F:
    """Decorate a function so that its linear algebra runs in one thread.

    The matrices are small: several threads mostly wait for each other (forty times longer than
    they work, on a busy machine), and the rounding depends on the number of threads.
    """
    from threadpoolctl import threadpool_limits

    limited: F = threadpool_limits.wrap(1, user_api="blas")(function)
    return limited
