"""Compiled helpers that kernels of several rooms share: small linear algebra, rigid motions, the stereo residual.

They are inlined into kernels, which `slam.runtime.compilation` compiles and caches, and are imported by name. Vectors
and matrices are arrays that the caller owns; results are written into the last arguments. May import `runtime` alone.
"""
