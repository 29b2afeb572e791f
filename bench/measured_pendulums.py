"""Parameters of bicycles from raw measurements against the published ones, and what their covariance does to
the limits on the weave speed.

    python bench/measured_pendulums.py [--quick] [--json FILE]

Writes a list of {"figure", "model", "value", "required", "met"}. `--quick`: three bicycles, 200 samples each
instead of 2,000.
"""

import jax
import jax.numpy as jnp
import numpy as np
from figures import figure, main

from jourdain_jax.bicycle import (
    PARAMETER_NAMES,
    benchmark_from_measurements,
    interval,
    linear_matrices,
    measured_bicycle,
    sample_parameters,
    shipped_bicycles,
    shipped_measurements,
    stability_speeds,
)

ABOUT_CENTRES = ("xB", "zB", "xH", "zH", "IByy", "IHyy")  # published as means over pairs of lines
ROUNDED = ("Balanceassistv1",)  # its file gives two or three digits
SPLIT = ("Rigid",)  # moments of its fork follow from two mass centres


def against_published(name):
    """How far values and sigmas are from the published ones, in published sigmas."""
    found, published = benchmark_from_measurements(name), measured_bicycle(name)
    about = ABOUT_CENTRES + (("IHxx", "IHzz", "IHxz") if name in SPLIT else ())
    known = [n for n in PARAMETER_NAMES if published.sigmas[n] > 0]
    apart = lambda n: abs(found.values[n] - published.values[n]) / published.sigmas[n]
    others = [n for n in known if n not in about]
    off = max(map(apart, others))
    off_sigmas = max(abs(found.sigmas[n] / published.sigmas[n] - 1) for n in others)
    what = "published sigmas apart"
    yield figure(f"values that no mass centre enters, {what}", name, off, 0.1 if name in ROUNDED else 1e-6)
    most = None if name in ROUNDED + SPLIT else 1e-6
    yield figure("their sigmas, relative to the published ones, off by", name, off_sigmas, most)
    off = max(apart(n) for n in about if n in known)
    yield figure(f"values that follow from mass centres, {what}", name, off)


def weave_speeds(values):
    """Of many bicycles."""
    return jax.vmap(lambda one: stability_speeds(*linear_matrices(one)).weave_speed)(values)


OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
compiled = jax.jit(weave_speeds, compiler_options=OPTIONS)


def width(bicycle, count):
    """Of the 95 % limits on the weave speed, m/s."""
    samples = sample_parameters(bicycle, jax.random.key(0), count)
    nominal = jnp.array([[bicycle.values[n]] for n in PARAMETER_NAMES])
    values = jnp.where(samples.physical, samples.values.T, nominal)
    limits = interval(compiled(dict(zip(PARAMETER_NAMES, values, strict=True))), counted=samples.physical)
    return float(limits.high - limits.low)


def bicycles(quick):
    """Values and sigmas of every bicycle, and its limits on the weave speed."""
    names, ratios = ("Browser", "Crescendo", "Stratos") if quick else shipped_measurements(), []
    for name in names:
        if name in shipped_bicycles():
            yield from against_published(name)
        bicycle = benchmark_from_measurements(name)
        count = 200 if quick else 2000
        together, alone = width(bicycle, count), width(bicycle.with_independent_errors, count)
        ratios.append(together / alone)
        yield figure("95 % limits on the weave speed, width with covariance, m/s", name, together)
        yield figure("and with independent sigmas, m/s", name, alone)
        yield figure("one over the other", name, ratios[-1])
    what = "widths with covariance over those with independent sigmas, median"
    yield figure(what, f"{len(names)} bicycles", np.median(ratios))


if __name__ == "__main__":
    main(__doc__, (bicycles,))
