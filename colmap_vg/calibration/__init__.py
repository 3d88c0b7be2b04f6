"""Self-calibration: estimation of focal lengths from matches."""
