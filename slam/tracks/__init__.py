"""Tracks: the table of all that is followed or in the map, and the camera's pose on which landmarks agree.

`table` is that table, `follow` finds the features that continue its rows, `localizer` keeps the matches that agree on
one camera pose, `standing` says whether the camera stands; `alignment` moves features to the points first seen.
`mapper` counts, adds and erases landmarks after a frame, `monocular` triangulates features without a right image.
`step` is the frame in work, and whether the camera is tracked. May import `slam.geometry`, `slam.runtime` and the data.
"""
