"""Many motions at once: lanes in lockstep, rollouts."""
