"""Calibration of the camera from a map that was built with it, and plausibility of the camera without ground truth."""
