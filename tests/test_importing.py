"""What importing the package does to the process, and what it leaves until it is asked for."""

import ast
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jourdain_jax as jj

PROGRAM = """
import gc
import sys
import jourdain_jax as jj
import jax

assert gc.isenabled() and not gc.get_freeze_count()
jax.config.update("jax_num_cpu_devices", 3)  # an error where JAX has computed anything
assert jax.device_count() == 3

disc = jj.models.TiltingDisc()
assert jj.simulate(disc, jj.start(disc, lean=0.3, spin_rate=-3.0), t1=0.1).result == 0
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


def test_importing_computes_nothing_and_a_motion_imports_what_it_needs():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
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
