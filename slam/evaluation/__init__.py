"""How good a path is: ATE, RPE, segment errors, NEES, and whether associations are true.

May import `slam.geometry` and the data.
"""
