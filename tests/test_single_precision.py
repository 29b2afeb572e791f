"""Single precision finds the same static facts about a scene as double: ranks, freedoms, kinds of rows, growth."""

import json
import os
import subprocess
import sys

import pytest
from small_scenes import AffineRows, DrivenPendulum
from timed_scenes import DrivenOrientation, LosingMass

import jourdain_jax as jj
from jourdain_jax.models import BallOnTurntable, DoublePendulumRods, IsokineticParticle, TiltingDiscQuaternion, TwoWheelAxleRedundant

SCENES = (
    TwoWheelAxleRedundant,
    DoublePendulumRods,
    IsokineticParticle,
    TiltingDiscQuaternion,
    BallOnTurntable,
    AffineRows,
    DrivenPendulum,
    DrivenOrientation,
    LosingMass,
)
FACTS = ("rank", "ranks", "redundant_rows", "rank_losses", "independent", "affine", "homogeneous", "timed", "driven", "varying_inertia")
PROGRAM = """
import json, sys
sys.path[:0] = {path!r}
import jax, test_single_precision as here
assert not jax.config.jax_enable_x64
print(json.dumps([[here.facts(scene) for scene in here.SCENES], here.jj.report(here.TwoWheelAxleRedundant()).growth_vector]))
"""


def facts(scene) -> dict:
    structure = jj.structure_of(scene())
    return {name: getattr(structure, name) for name in FACTS}


@pytest.fixture(scope="module")
def in_single_precision():
    """The facts as found by a process of its own that never sees double precision."""
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(path=sys.path)],
        env=os.environ | {"JAX_ENABLE_X64": "0"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize("number", range(len(SCENES)), ids=[scene.__name__ for scene in SCENES])
def test_a_scenes_structure_does_not_depend_on_the_precision(in_single_precision, number):
    assert in_single_precision[0][number] == json.loads(json.dumps(facts(SCENES[number])))


def test_the_growth_vector_of_dependent_rows_does_not_depend_on_the_precision(in_single_precision):
    assert tuple(in_single_precision[1]) == jj.report(TwoWheelAxleRedundant()).growth_vector == (2, 3, 4)
