"""Analyses of scenes and states (integrability, report, energy, verification), and identification from
measurements.

Modules of a fit, from arguments to results:

    experiment   the measurements of each run: times, channels, sigmas, start, inputs
    sensors      between a motion and a channel, or a command and an input: gain, bias, delay, lag
    quantities   measured quantities of channels
    estimate     ranges and priors of unknowns
    layout       scene, starts and sensors from a vector theta
    unknowns     all unknowns of a fit
    runs         [J r]: residuals of many runs and their derivatives; one program for equal structures
    problem      the objective F(theta): sum rho(w) + sum n log sigma + priors, w: whitened r (correlated_noise)
    arrow        the linearised problem: shared unknowns, and unknowns of runs, eliminated run by run
    levenberg_marquardt    steps within bounds
    fit          from first guesses, over growing spans, off bounds
    shooting, piecewise, shooting_steps    multiple shooting: runs cut into pieces
    spread       uncertainty of the minimum: sigmas, quantiles, profiles, limits at bounds
    information  covariance, and undetermined directions
    estimates    values, intervals and residuals of a fit
    fit_result   `Fit`, its warnings and text
    resumed      a fit continued
    fit_page     its report

`likelihood`, `log_density` and `filtering` compute densities of the same runs, for derivatives and samplers.
"""
