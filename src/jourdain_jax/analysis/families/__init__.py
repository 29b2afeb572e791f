"""Families of steady and periodic motions, and the points where they fold, branch or change stability.

    equations.py -> curve.py -> special_points.py -> family.py

As parameters change, `critical.py` follows special points, and `chart.py` follows boundaries of stability.
`periodic.py` finds periodic orbits. Open `family.py` first.
"""
