"""Map management: adding and erasing landmarks (paper A, IV), keyframes and loops, map files.

`mapper` runs once per frame, `selection` chooses new landmarks, `culling` those to erase, `map_io` reads and
writes maps, and `atlas` closes loops. May import `slam.tracks`,
`slam.geometry` and the data.
"""
