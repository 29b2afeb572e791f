"""Facts about a scene, determined once: the traced graph, probed states, rank, independent speeds,
time dependence.

Every decision about how a scene is computed uses these facts; higher packages do not determine them again.
Open `structure.py` first; `probes.py` evaluates the graph at states of the domain, `assembly.py` projects
them onto the constraints, `rank.py` decides which quantities vanish.
"""
