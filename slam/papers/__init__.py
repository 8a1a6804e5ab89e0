"""Methods of the papers that the system has replaced by its own, as they were printed.

May import `slam.bodies`, `slam.tracks`, `slam.geometry`, `slam.runtime` and the data.
"""
