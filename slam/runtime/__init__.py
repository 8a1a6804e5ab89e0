"""Compiled kernels (Numba), the thread count of BLAS, memory that was freed, and timing.

Nothing of SLAM is known here; the kernels stand beside what they serve. May import nothing of `slam`.
"""
