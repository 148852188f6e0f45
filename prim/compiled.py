"""The numba decorators of all compiled kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(cache: bool = True, **options: Any) -> Callable[[Kernel], Kernel]:
    """Make a decorator that compiles a function with numba.

    A function that other kernels call is to be inlined into them and not cached by itself: else the state of the
    cache decides which of two translations is run, and with that the last bits of a sum.

    Args:
        cache: Whether the compiled code is kept in a file, where there is a folder that can be written.
        **options: Further options of numba.njit.

    Returns:
        The decorator.
    """

    def compile_it(function: Kernel) -> Kernel:
        try:
            made: Kernel = njit(cache=cache, nogil=True, error_model="numpy", **options)(function)
        except RuntimeError:  # neither this folder nor the user's cache can be written
            made = njit(nogil=True, error_model="numpy", **options)(function)
        return made

    return compile_it


kernel = compiled(inline="never")
"""Decorator of a kernel that Python calls."""

inline = compiled(inline="always")
"""Decorator of a function that kernels call: it becomes part of each of them."""
