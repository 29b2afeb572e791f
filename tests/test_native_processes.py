"""Machine code in threads and processes, and what many calls leave behind."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.integrate.loop.value_kernels import nodes_called
from jourdain_jax.program.graph import Graph

pytestmark = machine_code.needed

OPTIONS = {"ts": [0.2], "rtol": 1e-6, "atol": 1e-6, "backend": "native"}
FORKED = """
import os, sys
import jax

jax.config.update("jax_enable_x64", True)
import numpy as np
import jourdain_jax as jj


def ends():
    starts = {"lean": np.linspace(0.1, 0.3, 500)}
    return np.asarray(
        jj.rollout(
            jj.models.TiltingDisc(), starts, ts=[0.2], rtol=1e-6, backend="native"
        ).lanes.q_end
    )


children = []
for _ in range(2):  # before JAX begins: no program that uses it may be forked later
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writing, ends()[-1].tobytes())
        os._exit(0)
    children.append((child, reading))
own = ends()
for child, reading in children:
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert np.array_equal(np.frombuffer(os.read(reading, 4096)), own[-1])
"""


def _resident():
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _calls(kind):
    """A compiled function that calls machine code, and its argument."""
    if kind == "single precision":  # converted where the call begins and ends
        graph = Graph()
        inputs = [graph.input(f"x{i}", True) for i in range(50)]
        return jax.jit(nodes_called(graph, [graph.call("sin", x) for x in inputs], inputs)), jnp.ones(
            50, jnp.float32
        )
    disc = jj.models.TiltingDisc()

    def end(lean):
        return jnp.sum(jj.simulate(disc, {"lean": lean}, **OPTIONS).q_end)

    return jax.jit(jax.grad(end)), jnp.asarray(0.3)


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="this system does not say how much memory a process has"
)
@pytest.mark.parametrize("kind", ["gradients", "single precision"])
def test_ten_thousand_calls_leave_nothing_behind(kind):
    run, x = _calls(kind)
    found = []
    for _ in range(5):
        for _ in range(2000):
            y = run(x)
        y.block_until_ready()
        gc.collect()
        found.append(_resident())
    assert min(np.diff(found)) < 80_000  # 40 bytes for each call; now and then, allocators ask for more


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no process is forked here")
def test_workers_may_be_forked_before_jax_begins():
    subprocess.run([sys.executable, "-c", FORKED], check=True, timeout=120)
