"""How a motion ended: a code per lane, never an exception inside."""

SUCCESS, EVENT, MAX_STEPS, STEP_TOO_SMALL, NOT_FINITE, INCONSISTENT_START, SINGULAR_PARTITION = range(7)

MESSAGES = {
    SUCCESS: "reached the end of its span",
    EVENT: "stopped at an event",
    MAX_STEPS: "ran out of steps; raise `max_steps`, loosen the tolerances, or look for a singularity near the last time",
    STEP_TOO_SMALL: "the step size shrank to nothing: a singularity, a discontinuity, or rows that cannot be met near the last time",
    NOT_FINITE: "the accelerations are not finite; check the start, the parameters and the configuration with `accelerations` and `verify`",
    INCONSISTENT_START: "the start does not meet the constraints and could not be projected onto them",
    SINGULAR_PARTITION: "the privileged speeds came near a configuration where they do not determine the others; use state='full'",
}


class SimulationError(RuntimeError):
    """A motion did not reach its end; raised on request only (`trajectory.raise_if_failed()`), with the reason and the time."""
