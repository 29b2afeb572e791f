"""Facts found once about a scene: probed states, rank, privileged speeds, time dependence, the traced graph
of scalars.
"""
