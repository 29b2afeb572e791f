"""Plots of quantities over time, pictures and animations (matplotlib, extra `plot`), and 3D views for a
browser.
"""
