"""Poses, cameras, rigs, trajectories, and the camera's pose from points (PnP), with covariances where they have any.

Functions from arrays to arrays. May import `slam.runtime` and `slam.errors`.
"""
