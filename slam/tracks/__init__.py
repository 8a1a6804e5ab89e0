"""Tracks: the table of landmarks, the features that continue them, and the camera's pose on which these agree.

`table` holds all that is followed or in the map, `follow` matches it with a frame, `localizer` keeps the matches that agree on
one camera pose, `state` says whether the camera is tracked, `standing` whether it stands; `alignment` moves features to
the points first seen. May import `slam.geometry`, `slam.runtime` and the data.
"""
