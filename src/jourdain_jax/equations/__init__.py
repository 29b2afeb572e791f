"""Jourdain's principle of virtual power: kinematics -> virtual power -> rows -> reduction -> accelerations."""
