"""Motion in time: consistent starts, simulation, batches. No other layer uses diffrax."""
