"""Steps of a motion, and the loop over them as machine code, for lanes side by side."""
