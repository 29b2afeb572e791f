"""Measurements and unknowns: experiments, sensors and actuators, channels, first guesses and priors.

`run_preparation.py` checks an experiment against its scene. Open `experiment.py` first.
"""
