"""Analyses of scenes and states (integrability, report, energy, verification), and identification from
measurements.

The way of a fit, from arguments to results:

    experiment   what was measured in each run: times, channels, sigmas, start, inputs
    sensors      between a motion and a channel, between a command and an input: gain, bias, delay, lag       quantities: what a channel shows
    estimate     ranges and priors of unknowns        layout: which numbers of scene, starts and sensors a vector theta makes        unknowns: all of them
    runs         [J r]: residuals of many runs with their derivatives, one compiled program for runs of equal structure
    problem      F(theta), what is minimised: sum rho(w) + sum n log sigma + priors, w: whitened r (correlated_noise)
    arrow        the linearised problem: what runs share, and what is their own, which goes out run by run
    levenberg_marquardt    steps within bounds        fit: from first guesses, over growing spans, off bounds
    shooting, piecewise, shooting_steps    runs that are cut into pieces
    spread       how far the minimum is known: sigmas, quantiles, profiles, limits at bounds        information: covariance, and what does not show
    estimates    values, intervals and residuals of a fit        fit_result: `Fit`, its warnings and text        resumed: a fit taken up again
    fit_page     its report

`likelihood`, `log_density` and `filtering` make densities of the same runs, for derivatives and samplers.
"""
