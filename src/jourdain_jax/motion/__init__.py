"""Motions: `build`, `start`, `simulate`, `rollout`, and the trajectories that they return.

`model.py` makes every decision, with the vector field from `field_choice.py`; `simulate.py` and `rollout.py`
only check arguments and call `integration.py`. Only `diffrax_steps.py` knows diffrax. Open `simulate.py`
first, then `model.py`.
"""
