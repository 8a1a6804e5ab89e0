"""What enters a step: features of images, checked; and warnings about images, stamps and baselines that look wrong.

May import `slam.geometry`, `slam.runtime` and the data.
"""
