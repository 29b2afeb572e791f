"""Public names, imported on first use; static tools read them here."""

from . import analysis, bicycle, equations, identification, models, studies
from .analysis.families.chart import stability_chart
from .analysis.families.critical import critical
from .analysis.families.family import family
from .analysis.families.periodic import periodic
from .analysis.linearize import linearize
from .analysis.report import report
from .analysis.steady import steady
from .analysis.verify import energy, verify
from .calculus.configuration import configure
from .calculus.derivative_errors import DifferentiationModeError
from .calculus.rotations import quaternion_from_axis_angle, quaternion_to_matrix, rot_x, rot_y, rot_z, vec
from .dynamics.accelerations import Accelerations, Baumgarte, accelerations, reductions
from .dynamics.reactions import newton_residual
from .equations.kinematics import motion_at, pose_at
from .equations.virtual_power import virtual_power
from .identification.data.estimate import Estimate, bounds, positive
from .identification.data.experiment import Experiment
from .identification.fit import fit, fit_batch
from .importers.mjcf import from_mjcf
from .importers.sympy_scene import from_sympy
from .importers.urdf import from_urdf
from .integrate.discrete_gradient import DiscreteGradient
from .integrate.discrete_lagrange_dalembert import DiscreteLagrangeDAlembert
from .integrate.explicit_steps import Taylor
from .integrate.implicit_steps import ImplicitMidpoint, RadauIIA
from .integrate.inputs import Sampled
from .integrate.result_codes import SimulationError
from .integrate.state import State
from .integrate.vector_fields.field import Formulation
from .lowering.lower import lower
from .lowering.lowered_equations import Lowered, NotLowered
from .motion.check import Checked, check
from .motion.diffrax_steps import diffrax_term
from .motion.model import Model, build, load_model
from .motion.options import Options
from .motion.rollout import Rollout, rollout
from .motion.sensitivity import SensitivityWarning
from .motion.simulate import simulate
from .motion.start import consistent, start
from .motion.trajectories.diagnostics import diagnose
from .motion.trajectories.storage import load_rollout, load_trajectory, save
from .motion.trajectories.trajectory import Trajectory
from .scene.bodies import Particle, RigidBody, Visual
from .scene.contact.contacts import (
    Contact,
    Coulomb,
    ball_contact,
    disc_contact,
    ellipsoid_contact,
    wheel_contact,
)
from .scene.contact.grounds import Cylinder, HeightMap, Plane, Sphere, Surface
from .scene.coordinates import coordinates, inputs, parameter, quaternion, speeds
from .scene.identity import clear_caches
from .scene.loads import (
    Load,
    damper,
    generalized_force,
    gravity,
    joint_friction,
    knife_edge,
    pin,
    point_force,
    rod,
    spring,
    torque,
    weld,
)
from .scene.modes import Event, modes
from .scene.motion_state import fixed_point
from .scene.scene import Scene
from .scene.spline import Spline
from .structure.sampling import sample_states
from .structure.structure import structure_of
from .studies.result import load_study
from .studies.study import Study
from .views.pictures import animate
from .views.quantities import plot
from .views.show import View, show

__version__: str

__all__ = [
    "Accelerations",
    "Baumgarte",
    "Checked",
    "Contact",
    "Coulomb",
    "Cylinder",
    "DifferentiationModeError",
    "DiscreteGradient",
    "DiscreteLagrangeDAlembert",
    "Estimate",
    "Event",
    "Experiment",
    "Formulation",
    "HeightMap",
    "ImplicitMidpoint",
    "Load",
    "Lowered",
    "Model",
    "NotLowered",
    "Options",
    "Particle",
    "Plane",
    "RadauIIA",
    "RigidBody",
    "Rollout",
    "Sampled",
    "Scene",
    "SensitivityWarning",
    "SimulationError",
    "Sphere",
    "Spline",
    "State",
    "Study",
    "Surface",
    "Taylor",
    "Trajectory",
    "View",
    "Visual",
    "accelerations",
    "analysis",
    "animate",
    "ball_contact",
    "bicycle",
    "bounds",
    "build",
    "check",
    "clear_caches",
    "configure",
    "consistent",
    "coordinates",
    "critical",
    "damper",
    "diagnose",
    "diffrax_term",
    "disc_contact",
    "ellipsoid_contact",
    "energy",
    "equations",
    "family",
    "fit",
    "fit_batch",
    "fixed_point",
    "from_mjcf",
    "from_sympy",
    "from_urdf",
    "generalized_force",
    "gravity",
    "identification",
    "inputs",
    "joint_friction",
    "knife_edge",
    "linearize",
    "load_model",
    "load_rollout",
    "load_study",
    "load_trajectory",
    "lower",
    "models",
    "modes",
    "motion_at",
    "newton_residual",
    "parameter",
    "periodic",
    "pin",
    "plot",
    "point_force",
    "pose_at",
    "positive",
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
    "speeds",
    "spring",
    "stability_chart",
    "start",
    "steady",
    "structure_of",
    "studies",
    "torque",
    "vec",
    "verify",
    "virtual_power",
    "weld",
    "wheel_contact",
]
