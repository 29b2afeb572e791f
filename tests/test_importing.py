"""What importing the package does to the process."""

import subprocess
import sys

PROGRAM = """
import gc
import jourdain_jax
import jax
assert gc.isenabled() and not gc.get_freeze_count()
jax.config.update("jax_num_cpu_devices", 3)  # an error where JAX has computed anything
assert jax.device_count() == 3
"""


def test_importing_computes_nothing_and_leaves_garbage_collection_on():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
