"""Results of motions: states over time, result codes, diagnostics, files."""
