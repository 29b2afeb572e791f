"""What a motion leaves: states over time, result codes, diagnostics, files."""
