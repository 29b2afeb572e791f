"""Motions: `build`, `start`, `simulate`, `rollout`, and the trajectories that they return.

`model.py` makes all decisions and takes the vector field from `field_choice.py`. `simulate.py` and
`rollout.py` check arguments and call `integration.py`. Only `diffrax_steps.py` depends on diffrax. Open
`simulate.py` first, then `model.py`.
"""
