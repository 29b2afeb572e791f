"""Session set-up: run-time shape checks, a headless plot backend, a compile cache; no precision is set here.

`JOURDAIN_JAX_NO_TYPE_CHECKS=1` switches the jaxtyping/beartype checks off (faster, for timing only).
"""

import gc
import os
from pathlib import Path

import jaxlib

os.environ.setdefault("MPLBACKEND", "Agg")
# Most of the time of a test is spent compiling. With less effort on machine code the same tests take half as long; the flags belong to the
# tested version of jaxlib (another one might not know them). Timings are taken in `bench/`, with none of this.
if jaxlib.__version__.startswith("0.10."):
    quick = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
    os.environ.setdefault("XLA_FLAGS", f"{quick} --xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1")
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # no line numbers for each operation of a program

import jax
import pytest
from jaxtyping import install_import_hook

# Before any import of the package: every annotated function of these layers is then checked, shapes and dtypes included. Not in the layers whose small
# functions are called a million times while scenes are traced: there it takes a tenth of the time of all tests.
LAYERS = ("equations", "dynamics", "motion", "analysis", "ensembles", "models", "bicycle", "plotting", "cli")
if os.environ.get("JOURDAIN_JAX_NO_TYPE_CHECKS") != "1":
    install_import_hook([f"jourdain_jax.{layer}" for layer in LAYERS], "beartype.beartype")


# What takes longest for its number of tests, longest first: started last, one of these would keep one worker busy while the others have nothing to do.
LONGEST = ("every_model", "simulate", "kept_parts", "contacts_on_surfaces", "generated_scenes", "identify", "structure_preserving", "stiff", "rollout", "power")
LONGEST += ("traced_parameters", "float32", "notebooks", "bicycle_job", "bicycle_stability", "atlas", "readme")


SLOW = frozenset(line for line in (Path(__file__).parent / "slow.txt").read_text().splitlines() if not line.startswith("#"))


@pytest.hookimpl(tryfirst=True)  # before pytest looks at marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what `slow.txt` names; the longest files first."""
    for item in items:
        if item.nodeid.removeprefix("tests/") in SLOW:
            item.add_marker(pytest.mark.slow)
    last = len(LONGEST)
    order = {f"test_{name}": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, last))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Tracing makes millions of objects that live for a moment: what is there for good is not looked through again and again for garbage among it."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_are_dropped():
    """Compiled programs hold memory maps, of which a process may have 65530 on Linux: without this a long run aborts inside the compiler."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > 35_000:
        jax.clear_caches()
        gc.collect()


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs in pytest's cache, so that a second run does not compile again; keep the order of files above for pytest-xdist."""
    config.option.loadscopereorder = False  # it would hand out files by their number of tests
    if not config.pluginmanager.hasplugin("cacheprovider"):
        return
    compiled: Path = config.cache.mkdir("jax_compilation")
    jax.config.update("jax_compilation_cache_dir", str(compiled))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """A run in which every test was skipped has tested nothing: fail it as pytest fails an empty run."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    on_worker = "PYTEST_XDIST_WORKER" in os.environ
    if reporter is None or on_worker or session.config.option.collectonly or exitstatus != pytest.ExitCode.OK:
        return
    if not any(reporter.stats.get(outcome) for outcome in ("passed", "failed", "xfailed", "xpassed")):
        session.exitstatus = pytest.ExitCode.NO_TESTS_COLLECTED
