"""Room: calibration."""
