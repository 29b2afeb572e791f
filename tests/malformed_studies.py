"""Malformed designs and studies, as one table: see `malformed_inputs`."""

PRELUDE = """
import datetime

import numpy as np
import jourdain_jax as jj

TWO = {"mass": jj.studies.Normal(12.0, 0.3), "radius": jj.studies.Uniform(0.3, 0.4)}
disc = jj.models.TiltingDisc()
by_radius = jj.Study(disc, vary={"radius": [0.5]})
"""

DESIGNS: dict[str, str] = {
    "jj.studies.Normal(1.0, -0.1)": "`sigma` of Normal is -0.1",
    "jj.studies.Normal('heavy', 0.1)": "`mean` of Normal",
    "jj.studies.Uniform(1.0, 1.0)": "expected low < high",
    "jj.studies.LogUniform(0.0, 1.0)": "expected a positive number",
    "jj.studies.LogNormal(-1.0, 1.0)": "positive number",
    "jj.studies.Uniform(0.0, np.inf)": "expected a finite number",
    "jj.studies.Levels([])": "at least one",
    "jj.studies.Design({})": "nothing varies",
    "jj.studies.Design({'a': jj.studies.Normal(0, 1), 'b': [1.0, 2.0]}, samples=2)": (
        "columns and distributions at once"
    ),
    "jj.studies.Design({'a': 3.0})": "`a` varies as",
    "jj.studies.Design({'a': [1.0, np.nan]})": "not finite",
    "jj.studies.Design({'a': [1.0], 'b': [1.0, 2.0]})": "`a` has 1, `b` has 2",
    "jj.studies.Design({'a': [1.0]}, samples=3)": "omit `samples`",
    "jj.studies.Design(TWO)": "`samples` is None",
    "jj.studies.Design(TWO, sampler='sobel', samples=8)": "did you mean `sobol`",
    "jj.studies.Design(TWO, sampler='grid', samples=8)": (
        "a grid takes `jj.studies.Levels`, but `mass` varies as"
    ),
    "jj.studies.Design(TWO, samples=8, seed=-1)": "`seed` is -1",
    "jj.studies.Design(TWO, sampler='saltelli', samples=9)": "a multiple of 4",
    "jj.studies.Design(TWO, samples=8, correlation={('mass', 'lenght'): 0.5})": (
        "`lenght`, which does not vary"
    ),
    "jj.studies.Design(TWO, samples=8, correlation={('mass', 'radius'): 1.0})": "between -1 and 1",
    "jj.studies.Design(TWO, samples=8, correlation={('mass', 'radius'): '0.5'})": "expected real numbers",
    "jj.studies.Design(TWO, samples=8, correlation={'mass': 0.5})": "expected pairs of names",
    "jj.studies.Design({'a': [[1.0], [1.0, 2.0]]})": "`a` varies as",
    "jj.studies.Design({f'a{i}': jj.studies.Levels([0.0] * 10) for i in range(20)})": (
        "form 100000000000000000000 samples"
    ),
    "jj.studies.Design(TWO, samples=8).values(0, 9)": "not among 0 to 8",
}

STUDIES: dict[str, str | tuple[str, str]] = {
    "jj.Study(disc, vary={'radios': jj.studies.Normal(0.5, 0.1)}, samples=8)": "did you mean `radius`",
    "jj.Study(disc, vary={'radius': 0.5}, samples=8)": "set one value on the scene",
    "jj.Study(disc, vary=[1.0])": "`vary` is",
    "jj.Study(disc, start={'laen': jj.studies.Normal(0.5, 0.1)}, samples=8)": "did you mean `lean`",
    "jj.Study(disc, start={'lean': 0.2}, samples=8)": "nothing varies",
    "by_radius.task(save='everything')": "`save` is 'everything'",
    "by_radius.task(save='trajectories')": "trajectories are kept by `keep_every=1`",
    (
        "jj.Study(disc, start={'lean': jj.studies.Uniform(0.1, 0.2), 'spin_rate': datetime.date(2020, 1, "
        "1)}, samples=8)"
    ): ("start `spin_rate` is a date"),
    "by_radius.task(keep_every=10**30)": (
        "`keep_every` is 1000000000000000000000000000000, expected a whole number"
    ),
    "by_radius.task(keep_every=0)": "`keep_every` is 0, expected a whole number of at least 1",
    "by_radius.task(every=2)": (
        "TypeError",
        "Study.run() takes no `every`: `keep_every=N` stores the trajectory of every N-th sample",
    ),
    "by_radius.task(t1=-np.inf)": "t1",
    "by_radius.task(outputs={'x': jj.studies.End('leen')})": "did you mean `lean`",
    "by_radius.task(outputs={'x': jj.studies.EventTime('fell')})": "did you mean `fallen`",
    "by_radius.task(outputs={'a/b': jj.studies.End('lean')})": "without `/`",
    "by_radius.task(outputs={'a\\\\b': jj.studies.End('lean')})": "without `/`",
    "by_radius.task(outputs={'a\\0': jj.studies.End('lean')})": "printable text of at most 200 bytes",
    "by_radius.task(outputs={'a\\n': jj.studies.End('lean')})": "printable text of at most 200 bytes",
    "by_radius.task(outputs={'\\ud800': jj.studies.End('lean')})": "printable text of at most 200 bytes",
    "by_radius.task(outputs={'a' * 201: jj.studies.End('lean')})": "printable text of at most 200 bytes",
    "by_radius.task(outputs={'x': jj.studies.End})": "expected an output",
    "by_radius.task(outputs={'x': jj.studies.Integral('lean')}, ts=[0.5, 1.0])": "`x` would omit",
    "by_radius.run('x', outputs={'lane': jj.studies.End('lean')})": "would name two arrays",
    "by_radius.run('x', outputs={'run': jj.studies.End('lean')})": "would name two arrays",
    "by_radius.run('x', outputs={'radius': jj.studies.End('lean')})": "would name two arrays",
    "jj.Study(disc, vary={'radius': [0.5] * 9}).run('x', chunk=7)": "a multiple of 16",
    "by_radius.run('x', shard=(3, 2))": "`shard` is",
    "jj.Study(disc, start={'lean': jj.studies.Normal(0, 1)}, samples=2, correlation={3: 0.5})": (
        "expected pairs of names"
    ),
    "jj.Study(disc, start={'lean': jj.studies.Normal(0, 1)}, samples=2, correlation=np.eye(2))": (
        "`correlation` is"
    ),
}

TABLE = DESIGNS | STUDIES
