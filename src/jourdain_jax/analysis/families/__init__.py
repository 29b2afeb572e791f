"""Families of steady and periodic motions, and the points where they fold, branch or change stability.

    equations.py -> curve.py -> special_points.py -> family.py

`critical.py` follows special points, `chart.py` boundaries, as parameters change; `periodic.py` finds orbits.

Open `family.py` first.
"""
