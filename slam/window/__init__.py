"""Least squares over a few poses and many points that a stereo rig sees: `solve`, and what leaves a prior behind.

The camera in its window, a pose from known points, two views, and a body's motion are calls of it. May import
`geometry`, `kernels` and `runtime`.
"""
