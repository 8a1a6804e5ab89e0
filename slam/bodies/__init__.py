"""Moving objects: found without being told, measured with covariance.

`detector` is the step: it follows features, classifies them as still or moving, and keeps the bodies that they make up.
May import `slam.tracks`, `slam.window`, `slam.geometry`, `slam.runtime` and the data.
"""
