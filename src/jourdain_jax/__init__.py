"""Differentiable dynamics of holonomic and nonholonomic mechanical systems, by Jourdain's principle of virtual power.

Importing this package switches JAX to 64-bit floats, unless the environment variable JAX_ENABLE_X64 is set to 0; asks for at least 16
threads on the CPU, unless PJRT_NPROC or NPROC is set; and lets XLA compile small loops on the CPU into one function each, unless XLA_FLAGS
holds `xla_backend_extra_options`. The last two take effect if JAX has not computed anything yet.

Fits, studies, pictures and other parts that a first motion does not need are imported on first use.
"""

import os as _os
import typing as _typing

import jax as _jax

from jourdain_jax.calculus.lazy_imports import module_on_first_use as _module_on_first_use
from jourdain_jax.calculus.lazy_imports import names_on_first_use as _names_on_first_use

if _os.environ.get("JAX_ENABLE_X64", "1").lower() not in ("0", "false", "off"):
    _jax.config.update("jax_enable_x64", True)

# A batched LAPACK call of jaxlib 0.10 waits, in a thread of the pool, for work that is queued on the same pool: as many such calls at once as
# there are threads wait for ever (seen with two cores and batches of some thousand). jaxlib 0.11 no longer splits batches.
if not {"PJRT_NPROC", "NPROC"} & _os.environ.keys():
    _os.environ["PJRT_NPROC"] = str(max(16, _os.cpu_count() or 1))

# By default XLA compiles a loop into one function if its body touches less than 1 kB; beyond, it starts every operation of the body on its own,
# which takes ten times as long as the arithmetic of a step (a disc alone: 2.9 ms, with this 0.22 ms).
if "xla_backend_extra_options" not in _os.environ.get("XLA_FLAGS", ""):
    _option = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1048576"
    _os.environ["XLA_FLAGS"] = f"{_os.environ.get('XLA_FLAGS', '')} {_option}".strip()

from jourdain_jax import models
from jourdain_jax.calculus.derivatives import DifferentiationModeError
from jourdain_jax.calculus.lazy_imports import version_of as _version_of
from jourdain_jax.calculus.rotations import quaternion_from_axis_angle, quaternion_to_matrix, rot_x, rot_y, rot_z
from jourdain_jax.dynamics.accelerations import Accelerations, Baumgarte, accelerations, reductions
from jourdain_jax.dynamics.newton_euler import newton_residual
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at, partial_velocities, pose_at
from jourdain_jax.equations.reductions import Multipliers, NullSpaceQR, NullSpaceSVD, Privileged, UdwadiaKalaba
from jourdain_jax.equations.rows import position_residual, velocity_residual
from jourdain_jax.equations.virtual_power import (
    generalized_forces,
    kinetic_energy,
    potential_energy,
    unconstrained_equations,
    virtual_power,
)
from jourdain_jax.integrate.explicit_steps import Taylor
from jourdain_jax.integrate.inputs import Sampled
from jourdain_jax.integrate.result_codes import SimulationError
from jourdain_jax.integrate.state_projection import State
from jourdain_jax.integrate.vector_fields.field import Formulation
from jourdain_jax.lowering.lower import lower
from jourdain_jax.lowering.lowered_equations import Lowered, NotLowered
from jourdain_jax.motion.model import Model, build, load_model
from jourdain_jax.motion.options import Options
from jourdain_jax.motion.sensitivity import SensitivityWarning
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.motion.start import consistent, start
from jourdain_jax.motion.trajectories.diagnostics import diagnose
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.bodies import Particle, RigidBody
from jourdain_jax.scene.constraints import knife_edge, pin, rod, weld
from jourdain_jax.scene.contact.contacts import Contact, Coulomb, ball_contact, disc_contact, ellipsoid_contact, wheel_contact
from jourdain_jax.scene.contact.grounds import Cylinder, HeightMap, Plane, Sphere, Surface
from jourdain_jax.scene.contact.held_rows import joint_friction
from jourdain_jax.scene.coordinates import coordinates, inputs, quaternion, speeds
from jourdain_jax.scene.identity import clear_caches
from jourdain_jax.scene.loads import Load, damper, generalized_force, gravity, point_force, spring, torque
from jourdain_jax.scene.modes import Event, modes
from jourdain_jax.scene.motion_state import fixed_point
from jourdain_jax.scene.parameter_fields import parameter
from jourdain_jax.scene.possible_inertia import inertia_from_log_cholesky, log_cholesky
from jourdain_jax.scene.printing import show_scenes_with as _show_scenes_with
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.spline import Spline
from jourdain_jax.scene.visuals import Visual
from jourdain_jax.structure.sampling import sample_states
from jourdain_jax.structure.structure import structure_of

if _typing.TYPE_CHECKING:  # imported on first use
    from jourdain_jax.analysis.energy import Energy, EnergyBalance, energy, energy_balance
    from jourdain_jax.analysis.families.chart import stability_chart
    from jourdain_jax.analysis.families.critical import critical
    from jourdain_jax.analysis.families.family import family
    from jourdain_jax.analysis.families.periodic import periodic
    from jourdain_jax.analysis.linearize import Linearization, linearize
    from jourdain_jax.analysis.report import Report, report
    from jourdain_jax.analysis.statements import Verification, derivative_exists
    from jourdain_jax.analysis.steady import SteadyMotion, steady
    from jourdain_jax.analysis.verify import verify
    from jourdain_jax.equations.gibbs_appell import GibbsAppell, gibbs_equations, gibbs_function
    from jourdain_jax.equations.lagrange import lagrange_equations
    from jourdain_jax.identification.data.channels import Accelerometer, LoadCell
    from jourdain_jax.identification.data.estimate import Estimate, bounds, joint_normal, positive, unbounded
    from jourdain_jax.identification.data.experiment import Experiment
    from jourdain_jax.identification.data.sensors import Actuator, Sensor
    from jourdain_jax.identification.fit import fit, fit_batch
    from jourdain_jax.identification.inference.filtering import filtered_log_likelihood
    from jourdain_jax.identification.inference.likelihood import PlannedInformation, log_likelihood, planned_information
    from jourdain_jax.identification.inference.log_density import LogDensity, log_density
    from jourdain_jax.identification.report.fit_result import Fit
    from jourdain_jax.identification.solve.layout import possible_inertia
    from jourdain_jax.identification.solve.problem import huber, student_t
    from jourdain_jax.identification.solve.shooting import MultipleShooting
    from jourdain_jax.importers.mjcf import from_mjcf
    from jourdain_jax.importers.sympy_scene import from_sympy
    from jourdain_jax.importers.urdf import from_urdf
    from jourdain_jax.integrate.discrete_gradient import DiscreteGradient
    from jourdain_jax.integrate.discrete_lagrange_dalembert import DiscreteLagrangeDAlembert
    from jourdain_jax.integrate.implicit_midpoint import ImplicitMidpoint
    from jourdain_jax.integrate.radau import RadauIIA
    from jourdain_jax.motion.check import Checked, check
    from jourdain_jax.motion.diffrax_steps import diffrax_term
    from jourdain_jax.motion.rollout import Rollout, rollout
    from jourdain_jax.motion.trajectories.storage import load_rollout, load_trajectory, save
    from jourdain_jax.studies.design import Design
    from jourdain_jax.studies.distributions import Levels, LogNormal, LogUniform, Normal, Uniform
    from jourdain_jax.studies.folder_lock import InUseError
    from jourdain_jax.studies.mean_gradients import MeanGradients
    from jourdain_jax.studies.outputs import End, EventTime, Happened, Integral, Largest, LargestMagnitude, Quantity, Smallest
    from jourdain_jax.studies.result import StudyResult, load_study, merge_studies
    from jourdain_jax.studies.sobol import SobolIndices, sobol_indices
    from jourdain_jax.studies.study import Study
    from jourdain_jax.views.pictures import animate
    from jourdain_jax.views.quantities import plot
    from jourdain_jax.views.show import View, show
else:  # a static tool does not see it: to one, any other name is a mistake
    _GONE = {
        "Built": "it is `Model`, which `build` returns",
        "MuntheKaas": "the default solvers renormalise quaternions after each step, are as accurate and take "
            "half of its time",
    }
    __getattr__, __dir__ = _names_on_first_use(globals(), _GONE)

_pictures = _module_on_first_use("jourdain_jax.views.pictures")
_show_scenes_with(lambda scene: _pictures.scene_picture(scene))
__version__ = _version_of("jourdain-jax")

__all__ = [
    "Accelerations",
    "Accelerometer",
    "Actuator",
    "Baumgarte",
    "Checked",
    "Contact",
    "Coulomb",
    "Cylinder",
    "Design",
    "DifferentiationModeError",
    "DiscreteGradient",
    "DiscreteLagrangeDAlembert",
    "End",
    "Energy",
    "EnergyBalance",
    "Estimate",
    "Event",
    "EventTime",
    "Experiment",
    "Fit",
    "Formulation",
    "GibbsAppell",
    "Happened",
    "HeightMap",
    "ImplicitMidpoint",
    "InUseError",
    "Integral",
    "Largest",
    "LargestMagnitude",
    "Levels",
    "Linearization",
    "Load",
    "LoadCell",
    "LogDensity",
    "LogNormal",
    "LogUniform",
    "Lowered",
    "MeanGradients",
    "Model",
    "MultipleShooting",
    "Multipliers",
    "Normal",
    "NotLowered",
    "NullSpaceQR",
    "NullSpaceSVD",
    "Options",
    "Particle",
    "Plane",
    "PlannedInformation",
    "Privileged",
    "Quantity",
    "RadauIIA",
    "Report",
    "RigidBody",
    "Rollout",
    "Sampled",
    "Scene",
    "SensitivityWarning",
    "Sensor",
    "SimulationError",
    "Smallest",
    "SobolIndices",
    "Sphere",
    "Spline",
    "State",
    "SteadyMotion",
    "Study",
    "StudyResult",
    "Surface",
    "Taylor",
    "Trajectory",
    "UdwadiaKalaba",
    "Uniform",
    "Verification",
    "View",
    "Visual",
    "accelerations",
    "animate",
    "ball_contact",
    "bounds",
    "build",
    "check",
    "clear_caches",
    "consistent",
    "constraint_rows",
    "coordinate_rates",
    "coordinates",
    "critical",
    "damper",
    "derivative_exists",
    "diagnose",
    "diffrax_term",
    "disc_contact",
    "ellipsoid_contact",
    "energy",
    "energy_balance",
    "family",
    "filtered_log_likelihood",
    "fit",
    "fit_batch",
    "fixed_point",
    "from_mjcf",
    "from_sympy",
    "from_urdf",
    "generalized_force",
    "generalized_forces",
    "gibbs_equations",
    "gibbs_function",
    "gravity",
    "huber",
    "inertia_from_log_cholesky",
    "inputs",
    "joint_friction",
    "joint_normal",
    "kinetic_energy",
    "knife_edge",
    "lagrange_equations",
    "linearize",
    "load_model",
    "load_rollout",
    "load_study",
    "load_trajectory",
    "log_cholesky",
    "log_density",
    "log_likelihood",
    "lower",
    "merge_studies",
    "models",
    "modes",
    "motion_at",
    "newton_residual",
    "parameter",
    "partial_velocities",
    "periodic",
    "pin",
    "planned_information",
    "plot",
    "point_force",
    "pose_at",
    "position_residual",
    "positive",
    "possible_inertia",
    "potential_energy",
    "quaternion",
    "quaternion_from_axis_angle",
    "quaternion_to_matrix",
    "reductions",
    "report",
    "rod",
    "rollout",
    "rot_x",
    "rot_y",
    "rot_z",
    "sample_states",
    "save",
    "show",
    "simulate",
    "sobol_indices",
    "speeds",
    "spring",
    "stability_chart",
    "start",
    "steady",
    "structure_of",
    "student_t",
    "torque",
    "unbounded",
    "unconstrained_equations",
    "velocity_residual",
    "verify",
    "virtual_power",
    "weld",
    "wheel_contact",
]
