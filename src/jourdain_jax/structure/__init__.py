"""What is found once for a scene: the traced graph, probed states, rank, independent speeds, time dependence.

Every decision about how a scene is computed uses these findings, and nothing below `build` decides again.
Open `structure.py` first; `probes.py` evaluates the graph at states of the domain, `assembly.py` puts them on
the constraints.
"""
