"""Steps of a motion, and the loop over them, as machine code for several lanes at once."""
