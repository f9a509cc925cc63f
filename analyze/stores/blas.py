"""One thread for each matrix product of numpy, while several episodes are computed at once.

threadpoolctl does the same, but lets only the first thread of a process that limits OpenBLAS do so from then on (3.8);
scans may begin in any thread.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import product

import numpy as np

#: The number of threads belongs to the library, so there is one limit for the process: how many there were when each
#: block that is open began.
_LOCK, _BEFORE = threading.Lock(), list[int]()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Compute matrix products with one thread each within the block; afterwards with as many as before.

    Threads of OpenBLAS that wait keep a core busy. Beside other work they make a scan ten times slower, and the
    episodes have threads of their own (`parallel.map_episodes`). Blocks of several threads may overlap. Nothing changes
    where numpy uses a library that offers no such call (Apple's Accelerate).
    """
    functions = _thread_functions()
    if functions is None:
        yield
        return
    get, limit = functions
    with _LOCK:
        _BEFORE.append(get())
        limit(1)
    try:
        yield
    finally:
        with _LOCK:
            limit(_BEFORE.pop())  # 1, unless it is the last block


@cache
def _thread_functions() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Return (number of threads, set it) of the BLAS library that numpy is linked with."""
    # A symbol is searched in a library and in what it is linked with, so numpy's own extension leads to its BLAS.
    library = ctypes.CDLL(np.linalg._umath_linalg.__file__)
    names = [
        (f"{prefix}openblas_get_num_threads{suffix}", f"{prefix}openblas_set_num_threads{suffix}")
        for prefix, suffix in product(("scipy_", ""), ("64_", ""))
    ]
    for get, limit in [*names, ("MKL_Get_Max_Threads", "MKL_Set_Num_Threads")]:
        if hasattr(library, limit):
            return getattr(library, get), getattr(library, limit)
    return None
