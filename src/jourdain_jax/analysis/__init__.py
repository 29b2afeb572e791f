"""What can be said of a scene and of a state: integrability, report, energy, verification."""
