"""Which features become landmarks, which landmarks are erased, and maps in files.

`mapper` is the step (paper A, IV), `selection` chooses new landmarks, `culling` those to be erased, `monocular` gives
depth without a right image, `map_io` writes maps and `map_search` finds the camera in one. May import
`slam.tracking`, `slam.geometry` and the data.
"""
