"""Studies of many motions: designs, runs that survive interruption, storage, statistics, Sobol' indices.

`study.py` -> `design.py` -> `task.py` (one block of samples) -> `run.py` -> `store.py`. Files on disk keep
their format between versions. Open `study.py` first.
"""
