"""Result codes of motions. Each motion, even in a batch, has a result code instead of raising an exception.

Codes up to `EVENT` mark motions that reached the end of their span or an event; all others failed.
"""

(
    SUCCESS,
    EVENT,
    MAX_STEPS,
    STEP_TOO_SMALL,
    NOT_FINITE,
    INCONSISTENT_START,
    SINGULAR_PARTITION,
    BAD_PARAMETER,
    BAD_START,
    UNSOLVED_STEP,
) = range(10)
SHRANK = 10  # code
STIFF = 11  # code
OFF_CONSTRAINTS = 12  # code
BAD_TIMES = 13  # code
ENERGY_LOST = 14  # code
PROCESS_DIED = 15  # code
CONTRADICTORY_ROWS = 16  # code
UNRESOLVED = 17  # code
TOO_MANY_TRANSITIONS = 18  # code
IMPACT_GAINS_ENERGY = 19  # code
PAINLEVE = 20  # code
CONTACTS_UNDECIDED = 21  # code
LIES_FLAT = 22  # code
STICKS = 23  # code
ZENO = 24  # code
AMBIGUOUS = 25  # code
CODES = tuple(name.lower() for name, code in globals().items() if type(code) is int)  # their names, in order

MESSAGES = {
    SUCCESS: "reached the end of its span",
    EVENT: "stopped at an event",
    MAX_STEPS: (
        "ran out of steps; raise `max_steps`, loosen the tolerances, use solver=jj.RadauIIA() or "
        "retry=True for stiff forces, or look for a singularity near the last time"
    ),
    STEP_TOO_SMALL: (
        "the step size shrank to zero near the last time: a singularity, a discontinuity, or "
        "constraints that cannot be satisfied; where constraints lose rank, pass retry=True"
    ),
    NOT_FINITE: (
        "the accelerations are not finite near the last time: a load, pose or constraint is NaN, or "
        "they are not unique (constraints lose rank, no inertia along a free direction); check the last "
        "state with `accelerations` and `verify`"
    ),
    INCONSISTENT_START: (
        "the start does not satisfy the constraints and could not be projected onto them; or "
        "a body starts below the ground of a contact with friction"
    ),
    SINGULAR_PARTITION: (
        "near the last time the independent speeds do not determine the others, or the scene's "
        "`coordinate_rates` become infinite; choose other `privileged` speeds, define other "
        "speeds, pass retry=True, or, unless constraints lose rank, "
        "`formulation=jj.Formulation('full')` with `backend='dense'`"
    ),
    BAD_PARAMETER: "a parameter is not finite or has the wrong sign",
    BAD_START: "the start is not finite; check where its values were computed",
    SHRANK: (
        "ran out of steps, which had shrunk below a hundredth of their average: a singularity, a "
        "discontinuity or a stiff force near the last time"
    ),
    STIFF: (
        "stiff: ran out of steps limited by stability rather than accuracy, and an implicit solver "
        "failed, too; replace a stiff spring or damper by a constraint, or loosen the tolerances"
    ),
    OFF_CONSTRAINTS: (
        "a fixed step left the constraints so far that the projection reversed more than half "
        "of it, or a diffrax solver left them by more than its step errors explain; use shorter "
        "steps or the default solver, or look for constraints that lose rank"
    ),
    BAD_TIMES: (
        "saved times lie outside the span or are not in order, the span is empty or not finite, or "
        "time runs backward despite friction; pass increasing `ts` between `t0` and `t1`"
    ),
    ENERGY_LOST: (
        "the energy, which should be constant, changed by more than the tolerances explain: the "
        "motion left its branch at a singular position, missed a short feature of a load, or a load's "
        "potential does not match its force (`verify`)"
    ),
    CONTRADICTORY_ROWS: (
        "redundant velocity constraints contradict each other at some saved time; omit one, "
        "or correct the inputs and times that determine them"
    ),
    PROCESS_DIED: "skipped by an earlier version, because its processes died repeatedly",
    UNRESOLVED: (
        "the step size shrank to zero, and `rtol` is below the resolution of this precision, 1.2e-7 "
        "in float32 and 2.2e-16 in float64: loosen it to 1e-5 and 1e-13, or set "
        "jax.config.update('jax_enable_x64', True)"
    ),
    TOO_MANY_TRANSITIONS: (
        "more than `max_transitions` events after which the motion continues: raise `max_transitions`"
    ),
    IMPACT_GAINS_ENERGY: (
        "an impact would gain energy by Newton's restitution and Coulomb's law; use "
        "impact='energetic' or a smaller restitution for the contact"
    ),
    PAINLEVE: (
        "Coulomb's law has no solution at a slipping contact, or none was found (Painleve's "
        "paradox); reduce its friction"
    ),
    CONTACTS_UNDECIDED: (
        "several contacts close, open or slip at once, and no tried combination of "
        "modes satisfies Coulomb's law; or slip reverses during an impact followed along its "
        "impulse: use impact='moreau'"
    ),
    LIES_FLAT: (
        "a disc or wheel with friction fell flat on its ground, where it has no single contact point; "
        "add contacts that can support it, or let an event end the motion earlier"
    ),
    STICKS: (
        "a load that jumps pushes the motion back onto its jump from both sides, as `jnp.sign` of a "
        "speed does at rest, so the motion cannot continue; use `friction=` of a contact or "
        "`jj.joint_friction`, which hold at rest, or smooth the load, as with `jnp.tanh`"
    ),
    ZENO: (
        "events follow each other within round-off, like the last bounces of a ball: let an event switch to "
        "a mode of rest, or use a contact with `friction=`, which comes to rest if its bounces shrink by a "
        "constant ratio; otherwise reduce `restitution=`"
    ),
    AMBIGUOUS: (
        "contacts with friction may move in several ways: open as well as stay closed, by Coulomb's law; "
        "reduce the friction, or start with a small speed in one of these ways"
    ),
    UNSOLVED_STEP: (
        "the equations of an implicit step were not solved near the last time; use a shorter "
        "step, or look for a singularity there"
    ),
}

# Retries after a failure, with `retry=True`. `Trajectory.fallback` is their sum.
AS_ASKED, FULL_STATE, IMPLICIT = 0, 1, 2  # code
FALLBACKS = {
    AS_ASKED: "",
    FULL_STATE: (
        "run again with the full state and dense matrices: the independent speeds or the "
        "scalar program became invalid"
    ),
    IMPLICIT: "run again with an implicit solver: the motion is stiff",
    FULL_STATE | IMPLICIT: (
        "run again with the full state, dense matrices and an implicit solver: the motion "
        "is stiff, and the independent speeds or the scalar program became invalid"
    ),
}


class SimulationError(RuntimeError):
    """Failure of a motion, raised only by `trajectory.raise_if_failed()`, with the reason and the time."""
