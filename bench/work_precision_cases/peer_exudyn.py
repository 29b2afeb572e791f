"""Exudyn's rolling disc: as a joint (no slip, implicit integrators of index-3 systems) and as a penalty
connector.

The version without range checks is asked for. Source: J. Gerstmayr, Multibody Syst. Dyn. 60 (2024) 553
(Exudyn).
"""

import sys
import warnings

import disc_body
import numpy as np

from work_precision_cases.curve import Curve, Prepared, Solved

sys.exudynFast = True  # read when it is imported
try:
    import exudyn
    from exudyn import itemInterface as items
    from exudyn.rigidBodyUtilities import RigidBodyInertia
except ImportError:
    exudyn = None

MISSING = "exudyn cannot be imported, so it is not measured; `pip install exudyn`"
STEPS = (1e-2, 2.5e-3, 1e-3, 2.5e-4, 1e-4, 5e-5)  # s
PENALTY_STEPS = (2.5e-3, 1e-3, 5e-4)
# Stiffness (N/m), damping (N s/m), friction coefficient, and the speed up to which friction is viscous (m/s):
# of those tried, the smallest error.
PENALTY = {
    "contactStiffness": 5e5,
    "contactDamping": 50.0,
    "dryFriction": [1e3, 1e3],
    "dryFrictionProportionalZone": 1e-3,
}


def _system(problem, penalty):
    container = exudyn.SystemContainer()
    system = container.AddSystem()
    scene, at_start = problem.scene, disc_body.start(float(problem.scene.radius), problem.minimal_start)
    m, a = float(scene.mass), float(scene.radius)
    marker = lambda body: system.AddMarker(items.MarkerBodyRigid(bodyNumber=body, localPosition=[0, 0, 0]))
    on_ground = marker(system.AddObject(items.ObjectGround()))
    body = system.CreateRigidBody(
        inertia=RigidBodyInertia(mass=m, inertiaTensor=m * a**2 * np.diag([0.25, 0.5, 0.25]), com=[0, 0, 0]),
        referencePosition=at_start.centre.tolist(),
        referenceRotationMatrix=at_start.rotation,
        initialVelocity=at_start.velocity.tolist(),
        initialAngularVelocity=at_start.angular_velocity.tolist(),
        gravity=[0, 0, -float(scene.gravity)],
    )
    rolling = {"markerNumbers": [on_ground, marker(body)], "discRadius": a, "discAxis": [0, 1, 0]}
    if penalty:
        node = system.AddNode(items.NodeGenericData(initialCoordinates=[0, 0, 0], numberOfDataCoordinates=3))
        rolling |= PENALTY | {"nodeNumber": node, "useLinearProportionalZone": True}
        system.AddObject(items.ObjectConnectorRollingDiscPenalty(**rolling))
    else:
        system.AddObject(items.ObjectJointRollingDisc(**rolling))
    system.Assemble()
    return container, system, body


def _settings(problem, step):
    settings = exudyn.SimulationSettings()
    time, newton = settings.timeIntegration, settings.timeIntegration.newton
    time.numberOfSteps, time.endTime, time.verboseMode = round(problem.end / step), problem.end, 0
    newton.useModifiedNewton, newton.relativeTolerance, newton.absoluteTolerance = True, 1e-10, 1e-12
    time.generalizedAlpha.spectralRadius = 0.9
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the name changed between versions; the old one serves in both
        settings.solutionSettings.writeSolutionToFile = False
        settings.solutionSettings.sensorsWritePeriod = problem.end
    return settings


def _by_exudyn(solver, penalty=False):
    def prepare(problem) -> Prepared:
        if exudyn is None:
            raise ImportError(MISSING)
        container, system, number = _system(problem, penalty)
        kind = getattr(exudyn.DynamicSolverType, solver)
        kinds = exudyn.OutputVariableType

        def run(step):
            settings = _settings(problem, step)
            try:
                done = system.SolveDynamic(settings, solverType=kind)  # always from the initial values
            except Exception as failure:
                return step, str(failure).splitlines()[0]
            return step, "" if done else "the solver says that it failed"

        def read(raw):
            step, failed = raw
            if failed:
                return Solved(failed=failed)
            of = lambda kind: np.array(system.GetObjectOutputBody(number, kind, [0, 0, 0]))
            rotation, omega = of(kinds.RotationMatrix).reshape(3, 3), of(kinds.AngularVelocity)
            body = disc_body.Body(of(kinds.Position), rotation, of(kinds.Velocity), omega)
            q, u = disc_body.state(float(problem.scene.radius), body, problem.truth.values)
            failed = "" if np.all(np.isfinite(q)) else "not finite"
            return Solved(q=q, u=u, steps=float(round(problem.end / step)), failed=failed)

        prepared = Prepared(run, read)
        prepared.run.__dict__["keeps"] = container  # the system dies with its container
        return prepared

    return prepare


def curves(problem, quick) -> list[Curve]:
    """Of the disc only; `quick`: one integrator."""
    if problem.name != "tilting-disc":
        return []
    ways = {
        "joint, generalized-alpha": (STEPS, "GeneralizedAlpha", False),
        "penalty, generalized-alpha": (PENALTY_STEPS, "GeneralizedAlpha", True),
    }
    found = [
        Curve(f"Exudyn, {name}", steps, _by_exudyn(*way), ("exudyn",), setting_unit="step (s)")
        for name, (steps, *way) in ways.items()
    ]
    return found[:1] if quick else found
