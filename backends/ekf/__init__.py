"""The papers' filter: an extended Kalman filter over camera and landmarks. See `backends.ekf.backend`.

In the papers' order:

- `camera`: what the filter asks of a camera, what an error is, and which errors nothing measures.
- `motion`: the camera's state and its transition (paper B, section 2), in angles kept from their singularity.
- `landmarks`: a landmark's three coordinates, and the table of all.
- `innovation`: measurement, ν and S (A, Eqs. 5-7; B, Eqs. 1-5); `solve`: gate, the update of the mean (A, Eq. 11), and
  what else is tried where it fails.
- `covariance`: ``A P Aᵀ + W Q Wᵀ`` (B, section 2), new landmarks (A, Eq. 10), ``P − K S Kᵀ`` (A, Eq. 11).
- `state`: camera, landmarks and covariance, the steps from one such state to the next, and inactive landmarks.
- `filter`: a back end for any camera; `backend`: the papers'.
"""

from backends.ekf.backend import EkfBackend, EkfConfig

__all__ = ["EkfBackend", "EkfConfig"]
