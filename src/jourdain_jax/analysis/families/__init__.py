"""Families of steady and periodic motions, and the points where they fold, branch or change stability.

    equations.py -> curve.py -> special_points.py -> family.py; critical.py and chart.py for points and boundaries

Open `family.py` first.
"""
