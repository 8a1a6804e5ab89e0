"""Which landmarks are in this frame and on which camera pose they agree; tracked, predicted, lost or kidnapped.

`association` matches features, `localizer` checks the matches by one camera pose, `gating` is the chi-square gate of
all estimators, `state` counts, `relocalization` deals with a kidnapped camera. May import `slam.geometry`,
`slam.runtime` and the data.
"""
