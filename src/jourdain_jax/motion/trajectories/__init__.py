"""Results of motions: states over time, diagnostics, labels, files. Open `trajectory.py` first."""
