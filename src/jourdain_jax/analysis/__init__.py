"""Analyses of scenes and states: `report`, `verify`, `energy`, `linearize`, `steady`, `family`, `periodic`.

`motion_derivatives.py` has the derivatives at one instant that linearisation, steady motions and families
share. Open `report.py` or `linearize.py` first.
"""
