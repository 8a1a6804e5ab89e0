"""Runs of the system or of one back end on recordings: files, figures, drawings, the viewer, recorded measurements.

`runner` drives a run, `run_files` writes its files, `results` says what its figures are, `plots` draws them;
`recording` and `replay` give the same measurements to any back end. May import everything but `slam.compare`,
`slam.testing` and `slam.commands`.
"""
