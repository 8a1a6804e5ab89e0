"""Data association, and whether the camera is tracked, predicted, lost or kidnapped.

`association` matches features with landmarks, `localizer` keeps the matches that agree on one camera pose, `gating` is
the chi-square gate of all estimators, `state` counts frames without a measured pose, `hypotheses` detects a kidnapped
camera. May import `slam.geometry`, `slam.runtime` and the data.
"""
