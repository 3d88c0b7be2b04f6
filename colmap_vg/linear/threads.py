"""Restriction of BLAS to one thread, for reproducible results and speed.

The matrices of viewing graphs are small: BLAS threads gain little on them and, on busy cores, wait for each other at
every call (a Cholesky factorisation of 600 unknowns took up to 1.4 s with several threads, 6 ms with one).
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

P = ParamSpec("P")
T = TypeVar("T")


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
