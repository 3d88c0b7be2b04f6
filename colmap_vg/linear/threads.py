"""One BLAS thread for the numerics: the same bits on any machine, and no waiting.

The matrices of viewing graphs are small: BLAS threads gain little on them, and where other jobs keep the cores busy
they wait for each other at every call (a Cholesky factor of 600 unknowns took up to 1.4 s with them, 6 ms without).
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

P = ParamSpec("P")
T = TypeVar("T")


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()  # it searches the loaded libraries: 5 ms, once


def single_threaded_blas(function: Callable[P, T]) -> Callable[P, T]:
    """Run a function with one BLAS thread."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
