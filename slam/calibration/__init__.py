"""The rig as something estimated: what the images tell about the error of its calibration.

May import `slam.geometry` and the data.
"""
