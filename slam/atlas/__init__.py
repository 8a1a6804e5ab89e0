"""Keyframes of places that the camera has left, place recognition, the pose graph that loops correct, and saved maps.

A layer above the back end, the same for every back end: the back end estimates the camera and the landmarks around it,
the atlas keeps the rest. `keyframes` holds a place's features, `places` proposes keyframes of the same place,
`verification` tests them by geometry, `loop_closer` decides on loops, `pose_graph` computes the keyframes' poses,
`atlas` puts them together, and `map_io` reads and writes maps. May import `slam.tracks`, `slam.window`, `slam.geometry`
and the data.
"""
