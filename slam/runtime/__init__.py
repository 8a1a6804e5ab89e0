"""Compiled kernels (Numba) and the thread count of BLAS: what the machine is asked to do, and how.

Nothing of SLAM is known here; the kernels stand beside what they serve. May import nothing of `slam`.
"""
