"""Motion in time: consistent starts, simulation, batches. The only layer that knows diffrax."""
