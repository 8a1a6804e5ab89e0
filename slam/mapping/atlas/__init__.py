"""Places that the camera has left: keyframes, how they are recognised, and the pose graph that a return corrects.

The layer above the back end, the same for every back end: a back end estimates the camera and the landmarks around it,
the atlas holds what lies behind. `keyframes` says what is kept, `places` which keyframe shows the same place, `loops`
whether that is so, `pose_graph` where all keyframes then are; `atlas` puts them together.
"""
