"""What was measured, and what is unknown: experiments, sensors and actuators, channels, guesses and priors.

Open `experiment.py` first.
"""
