"""Number of threads of a job, and restriction of BLAS to one, for reproducible results and speed.

The matrices of viewing graphs are small: BLAS threads gain little on them and, on busy cores, wait for each other at
every call (a Cholesky factorisation of 600 unknowns took up to 1.4 s with several threads, 6 ms with one).
"""

import os
from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

P = ParamSpec("P")
T = TypeVar("T")


def num_workers(num_threads: int) -> int:
    """Number of worker threads for an option `num_threads`, in which -1 stands for all cores."""
    return num_threads if num_threads > 0 else os.cpu_count() or 1


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()  # searches the loaded libraries, which takes 5 ms


def single_threaded_blas(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function to run with one BLAS thread."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
