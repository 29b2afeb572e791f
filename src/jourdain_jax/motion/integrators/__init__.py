"""How a motion is integrated: our explicit Runge-Kutta loop and its adjoint, solvers for diffrax, events, knots of the inputs."""
