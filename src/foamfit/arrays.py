"""Types and means of arrays, and the threads of linear algebra."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def means(values: Array, starts: Integers) -> Array:
    """Means of the parts of a signal that begin at `starts`."""
    return np.asarray(np.add.reduceat(values, starts) / np.diff(np.append(starts, len(values))))


def single_threaded(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Make a function that runs linear algebra in one thread.

    The matrices are small: several threads wait for each other most of the time, on a busy machine
    forty times as long as the work takes, and rounding depends on how many there are.
    """

    @wraps(function)
    def run(*args: _Given.args, **options: _Given.kwargs) -> _Result:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api="blas"):
            return function(*args, **options)

    return run
