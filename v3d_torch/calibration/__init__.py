"""Self-calibration of the camera from a map, and plausibility checks of the camera without ground truth."""
