"""The parts of a scene: coordinates, bodies, loads, constraints, contacts. No algorithms."""
