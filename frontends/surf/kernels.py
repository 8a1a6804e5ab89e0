"""How the compiled functions of this package are compiled.

Kernels are called from Python: they let go of the global lock and are cached on disk. Helpers are called from kernels
of the same file alone, because Numba notices changes in a kernel's own file only.
"""

from __future__ import annotations

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
helper = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
#: Sums may be reordered, so that loops run on vector registers; always the same way, whatever the number of threads.
vector_helper = njit(error_model="numpy", fastmath=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
