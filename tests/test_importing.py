"""What importing the package does to the process, and what it leaves until it is asked for."""

import ast
import inspect
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
left = {"diffrax", "optimistix", "lineax", "tqdm", "jourdain_jax.analysis", "jourdain_jax.studies", "jourdain_jax.views", "jourdain_jax.models.blades"}
imported = left & sys.modules.keys()
assert not imported, imported
from jourdain_jax import fit
"""
PACKAGES = (jj, jj.models)


def test_importing_computes_nothing_and_a_motion_imports_what_it_needs():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def _imports(package):
    """The module of each name that the source of a package imports, for the interpreter or for static tools."""
    nodes = ast.walk(ast.parse(Path(package.__file__).read_text()))
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module.startswith("jourdain_jax")]
    return {alias.asname or alias.name: node.module for node in froms for alias in node.names}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_public_names_are_there_and_those_that_static_tools_see(package):
    public, imports = set(package.__all__), _imports(package)
    assert public == {name for name in imports if not name.startswith("_") and name != "names_on_first_use"}
    assert public <= set(dir(package))
    for name in public:
        module = import_module(imports[name])
        assert getattr(package, name) is getattr(module, name, sys.modules.get(f"{module.__name__}.{name}")), name
    members = dict(inspect.getmembers(package))
    assert public <= members.keys()
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'sledge'"):
        package.sledge  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'sledge'"):
        exec(f"from {package.__name__} import sledge")
    exec(f"from {package.__name__} import *", found := {})
    assert public <= found.keys()


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
