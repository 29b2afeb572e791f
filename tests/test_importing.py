"""What importing the package does to the process, and what it leaves until it is asked for."""

import ast
import os
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jourdain_jax as jj

PROGRAM = """
import gc
import os
import sys
before = dict(os.environ)
import jourdain_jax as jj
import jax

assert gc.isenabled() and not gc.get_freeze_count()
jj.Scene  # the first use of a public name
assert dict(os.environ) == before | {
    "PJRT_NPROC": str(max(16, os.cpu_count())),
    "XLA_FLAGS": "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1048576",
}
jax.config.update("jax_num_cpu_devices", 3)  # an error where JAX has computed anything
assert jax.device_count() == 3

disc = jj.models.VerticalDisc()
assert jj.simulate(disc, jj.start(disc, roll_rate=-3.0), t1=0.1).result == 0
jj.clear_caches()  # of what is imported
left = {
    "diffrax",
    "optimistix",
    "lineax",
    "tqdm",
    "jourdain_jax.analysis",
    "jourdain_jax.studies",
    "jourdain_jax.views",
    "jourdain_jax.models.blades",
}
imported = left & sys.modules.keys()
assert not imported, imported
from jourdain_jax import fit
"""
PACKAGES = (jj, jj.models)


CONFIGURED = """
import os
before = dict(os.environ)
import jourdain_jax as jj
import jax

assert dict(os.environ) == before and jax.config.jax_enable_x64
try:
    jj.configure(threads=0)
except ValueError as error:
    assert "`threads` is `0`, expected a whole number from 1 to 1024" in str(error)
else:
    raise AssertionError
found = jj.configure(threads=3, xla_threads=17)
loops = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1048576"
assert found == {"JOURDAIN_JAX_THREADS": "3", "PJRT_NPROC": "17", "XLA_FLAGS": loops}
assert found.items() <= os.environ.items()
assert jj.configure() == found  # what is set stays

from jourdain_jax.kernels.host import threads
disc = jj.models.VerticalDisc()
assert jj.simulate(disc, jj.start(disc, roll_rate=-3.0), t1=0.1).result == 0 and threads() == 3
try:
    jj.configure()
except RuntimeError as error:
    assert "JAX has already computed something" in str(error)
else:
    raise AssertionError
assert found.items() <= os.environ.items()
"""
STARTED = """
import os
import jourdain_jax as jj
import jax.numpy as jnp

before = dict(os.environ)
jnp.zeros(3)
jj.Scene
assert dict(os.environ) == before
"""
BY_PACKAGE = """
import os
from jourdain_jax.bicycle import stability_speeds
assert int(os.environ["PJRT_NPROC"]) >= 16
"""
PROGRAMS = {
    "a package on its own": BY_PACKAGE,
    "computes nothing, and imports what a motion needs": PROGRAM,
    "configured": CONFIGURED,
    "after JAX has started": STARTED,
}


@pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)
def test_the_import_leaves_the_environment_alone_and_configure_says_what_it_sets(program):
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("XLA_FLAGS", "PJRT_NPROC", "NPROC", "JOURDAIN_JAX_THREADS")
    }
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=kept)
    assert done.returncode == 0, done.stderr


def _imports(package):
    """The module of each name that the stub of a package imports."""
    nodes = ast.walk(ast.parse(Path(package.__file__).with_suffix(".pyi").read_text()))
    return {
        alias.name: f"{package.__name__}.{node.module or alias.name}"
        for node in nodes
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_public_names_are_there_and_those_that_static_tools_see(package):
    public, imports = set(package.__all__), _imports(package)
    assert public == imports.keys()
    assert public <= set(dir(package))
    for name in public:
        module = import_module(imports[name])
        assert getattr(package, name) is getattr(module, name, module), name
    with pytest.raises(AttributeError, match="sledge"):
        package.sledge  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'sledge'"):
        exec(f"from {package.__name__} import sledge")
    exec(f"from {package.__name__} import *", found := {})
    assert public <= found.keys()


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("Normal", "studies"),
        ("Sensor", "identification"),
        ("gibbs_function", "equations"),
        ("Report", "analysis"),
        ("energy_balance", "analysis"),
    ],
)
def test_a_former_name_says_where_it_is(name, place):
    with pytest.raises(AttributeError, match=f"`jj.{place}.{name}`"):
        getattr(jj, name)


def test_models_are_pickled_by_their_own_modules():
    for name in ("tilting-disc", "two-wheel-axle-free"):
        scene = jj.models.model(name)
        assert pickle.loads(pickle.dumps(type(scene))) is type(scene) is jj.models.MODELS[name]
        assert repr(pickle.loads(pickle.dumps(scene))) == repr(scene)
    assert pickle.loads(pickle.dumps(jj.rollout)) is jj.rollout


def test_the_registry_holds_all_models():
    kinds = set(jj.models.MODELS.values())
    assert {kind.__name__ for kind in kinds} == set(jj.models.__all__) - {"MODELS", "model"}
    assert len(jj.models.MODELS) == len(kinds) == len(list(jj.models.MODELS))
    assert "sledge" not in jj.models.MODELS
    with pytest.raises(KeyError):
        jj.models.MODELS["sledge"]
