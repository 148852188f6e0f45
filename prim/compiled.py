"""The numba decorators of all compiled kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(cache: bool = True, **options: Any) -> Callable[[Kernel], Kernel]:
    """Numba's compiler; its code is cached where there is a place that can be written.

    A function that other kernels call is to be built into them (``forceinline``) and not cached by itself: else it
    depends on what was in the cache which of two translations is run, and with that the last bits of a sum.
    """

    def compile_it(function: Kernel) -> Kernel:
        try:
            made: Kernel = njit(cache=cache, nogil=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither this folder nor the user's cache can be written
            made = njit(nogil=True, error_model="numpy", **options)(function)
        return made

    return compile_it


kernel = compiled(inline="never")

inline = compiled(inline="always")
