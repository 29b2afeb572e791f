"""Numbers that say how a motion ended, as they stand in files of motions and studies: they never change."""

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
(
    SHRANK,
    STIFF,
    OFF_CONSTRAINTS,
    BAD_TIMES,
    ENERGY_LOST,
    PROCESS_DIED,
    CONTRADICTORY_ROWS,
    UNRESOLVED,
    TOO_MANY_TRANSITIONS,
) = range(10, 19)
IMPACT_GAINS_ENERGY, PAINLEVE, CONTACTS_UNDECIDED, LIES_FLAT, STICKS, ZENO, AMBIGUOUS = range(19, 26)
AS_ASKED, FULL_STATE, IMPLICIT = range(3)  # of `Trajectory.fallback`, which add up
