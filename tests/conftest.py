"""Session set-up: run-time shape checks, a headless plot backend; no precision is set here.

`JOURDAIN_JAX_NO_TYPE_CHECKS=1` switches the jaxtyping/beartype checks off (faster, for timing only).
"""

import ctypes
import gc
import importlib.metadata
import os
import sys
from functools import cache, partial, wraps
from pathlib import Path

import psutil
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")
# Most of the time of a test is spent compiling. With less effort on machine code the same tests take half as
# long. Timings are taken in `bench/`, with none of this.
quick = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    " --xla_cpu_parallel_codegen_split_count=1"
)
# Of loops as large as a motion these passes take a fourth of XLA's time.
quick += " --xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops"
if importlib.metadata.version("jaxlib").startswith("0.10."):  # from 0.11.1 on, an unknown flag
    quick += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", quick)
os.environ.setdefault(
    "JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0"
)  # no line numbers for each operation of a program

# Every annotated function of these layers that is not inside of another is checked, shapes and dtypes
# included. Not in the layers whose small functions are called a million times while scenes are traced: there
# it takes a tenth of the time of all tests.
LAYERS = (
    "equations",
    "dynamics",
    "integrate",
    "motion",
    "analysis",
    "identification",
    "studies",
    "models",
    "bicycle",
    "views",
    "cli",
)

# What takes longest, longest first: started last, one of these would keep one worker busy while the others
# have nothing to do.
LONGEST = """
friction modes sides held_rows crossings linearize identify malformed_inputs native_mutants inertia gpu
mutants periodic study_faults result_codes load_jumps native events feasible_starts types stiff sensors
log_density simulate build storage_faults report diffrax code_map lowering fit_report studies whipple_bicycle
rank_of_vanishing_rows quality native_functions native_derivatives call_costs rows_lost_at_rest extremes
readme inputs float32
"""


SLOW = frozenset(
    line for line in (Path(__file__).parent / "slow.txt").read_text().splitlines() if not line.startswith("#")
)


@pytest.hookimpl(tryfirst=True)  # before pytest looks at marks
def pytest_collection_modifyitems(items):
    """Marks what `slow.txt` names; the longest files first."""
    for item in items:
        name = item.nodeid.removeprefix("tests/")
        if not SLOW.isdisjoint({name, name.partition("[")[0]}):
            item.add_marker(pytest.mark.slow)
    order = {f"test_{name}": place for place, name in enumerate(LONGEST.split())}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish(session):
    """Tracing makes millions of objects that live for a moment: what is there for good is not looked through
    again and again for garbage among it.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


CHECKED: set = set()  # annotated functions that the file has called


@pytest.fixture(autouse=True, scope="module")
def _types_are_checked():
    """In the first call of each function in each file: in every call, checks took a tenth of the time of all
    tests.
    """
    CHECKED.clear()


@pytest.fixture(autouse=True, scope="module")
def _less_effort():
    """Machine code of our own is made with less effort, which changes no bit of a number, and XLA's programs
    of a file share a context of MLIR.

    JAX makes one for each, at 3 ms and a megabyte. A program that is lowered while another is gets its own.
    And JAX does not note for each operation all the lines that led to it, which took 3 to 5 % of a first
    motion.
    """
    from jax._src import source_info_util
    from jax._src.interpreters import mlir

    from jourdain_jax.kernels import host

    make, shared, noting = mlir.make_ir_context, mlir.make_ir_context(), source_info_util.current
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "EFFORT", 0)
        patch.setattr(mlir, "make_ir_context", lambda: make() if mlir.ir.Context.current else shared)
        patch.setattr(source_info_util, "current", lambda: source_info_util._source_info_context.context)
        yield noting


@pytest.fixture
def lines_are_noted(monkeypatch, _less_effort):
    """JAX notes the lines of each operation, as outside of tests."""
    from jax._src import source_info_util

    monkeypatch.setattr(source_info_util, "current", _less_effort)


MOST_RESIDENT = 1.9e9  # bytes of a process between files: two workers, with what a file adds, stay below 5 GB


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_are_dropped():
    """Compiled programs are dropped after a file where they hold much memory: machine code and its memory
    maps, of which a process may have 65530.

    What a file leaves behind is kept by caches: it is not searched for garbage until these are emptied, or
    else the search takes longer from file to file.
    """
    yield
    if psutil.Process().memory_info().rss > MOST_RESIDENT:
        import jourdain_jax as jj

        jj.clear_caches()
        gc.unfreeze()
        gc.collect()
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)  # glibc keeps what was freed otherwise
    gc.freeze()


@pytest.fixture(scope="module")
def small_blocks():
    """Blocks of a study are of 32 lanes, so that few lanes make several."""
    from jourdain_jax.studies import outputs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outputs, "LARGEST_BLOCK", 32)
        yield


@pytest.fixture
def drawn(monkeypatch):
    """All figures of matplotlib that are written."""
    from matplotlib.figure import Figure

    figures, written = [], Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda self, *given, **named: figures.append(self) or written(self, *given, **named),
    )
    return figures


@pytest.fixture
def compilations():
    """Programs that JAX compiles during a test, one entry each."""
    import jax

    found: list = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: found.append(event) if event.endswith("backend_compile_duration") else None
    )
    return found


def pytest_configure(config):
    """In a process that runs tests: run-time checks; machine code of our own is kept in pytest's cache, so
    that a second run does not make it again.

    Programs that XLA compiles are not kept: working out the key of each takes a tenth of its compilation.
    """
    config.option.loadscopereorder = (
        False  # pytest-xdist would hand out files by their number of tests, and not in the order above
    )
    if config.getoption("dist", "no") != "no" and not hasattr(config, "workerinput"):
        return  # this process hands out tests: workers start seconds sooner if it does not import JAX first
    gc.disable()  # until all tests are collected: what imports make is there for good
    import jax
    import jaxtyping
    from jaxtyping import _import_hook, install_import_hook

    jax.config.update("jax_enable_compilation_cache", False)
    if config.pluginmanager.hasplugin("cacheprovider"):
        jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("machine_code")))
    visit = _import_hook.JaxtypingTransformer.visit_FunctionDef

    def without_inner_functions(transformer, node):
        """These are made anew with each call of the one around them: making their checks anew each time took
        a tenth of the time of all tests.
        """
        body, node.body = node.body, []
        visit(transformer, node)
        node.body = body
        return node

    jaxtyped = jaxtyping.jaxtyped

    def checked_first(function, typechecker):
        """The function, checked the first time that a file of tests calls it; a class with its fields
        checked, each time that one is made.
        """
        if isinstance(function, type):
            return jaxtyped(function, typechecker=typechecker)
        checked = cache(lambda: jaxtyped(function, typechecker=typechecker))  # where it is called

        @wraps(function)
        def call(*args, **kwargs):
            if function in CHECKED:
                return function(*args, **kwargs)
            CHECKED.add(function)
            return checked()(*args, **kwargs)

        call.__code__ = call.__code__.replace(
            co_filename=jaxtyping._decorator.__file__
        )  # in tracebacks no line of a user
        return call

    if os.environ.get("JOURDAIN_JAX_NO_TYPE_CHECKS") != "1":
        jaxtyping.jaxtyped = lambda typechecker: partial(checked_first, typechecker=typechecker)
        _import_hook.JaxtypingTransformer.visit_FunctionDef = without_inner_functions
        install_import_hook(
            [f"jourdain_jax.{layer}" for layer in LAYERS], "beartype.beartype"
        )  # before any import of the package
    import jourdain_jax as jj

    jj.configure()  # some files of tests compute with JAX before they use the package


def pytest_sessionfinish(session, exitstatus):
    """A run in which every test was skipped has tested nothing: fail it as pytest fails an empty run."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    on_worker = "PYTEST_XDIST_WORKER" in os.environ
    if reporter is None or on_worker or session.config.option.collectonly or exitstatus != pytest.ExitCode.OK:
        return
    if not any(reporter.stats.get(outcome) for outcome in ("passed", "failed", "xfailed", "xpassed")):
        session.exitstatus = pytest.ExitCode.NO_TESTS_COLLECTED
