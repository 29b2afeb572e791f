"""The nouns of a scene: coordinates, bodies, loads, constraints, contacts. No algorithms."""
