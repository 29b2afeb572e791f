"""What a scene is made of: coordinates, bodies, loads, constraints, contacts. No algorithms."""
