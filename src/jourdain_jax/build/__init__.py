"""Facts found once per scene: probed states, rank, privileged speeds, time dependence, the traced graph of
scalars.
"""
