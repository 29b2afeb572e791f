"""Our explicit Runge-Kutta loop as machine code: the same steps as `motion/integrators/erk_step.py`, for lanes side by side."""
