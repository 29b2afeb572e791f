"""Check a scene for likely mistakes: things that can be computed but are hardly intended.

smoothness        jumps and kinks of poses, constraints and coordinate rates along lines through the domain
grounds           contact grounds that behave differently from their description
bodies            0 <= I_1 <= I_2 <= I_3 <= I_1 + I_2, and all conditions checked at the start of a motion
scalar program    rates and derivatives of the program, compared with JAX's
"""

from dataclasses import dataclass

from jourdain_jax.lowering.comparison import DIFFERS
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered_equations import NotLowered
from jourdain_jax.scene.arguments import BuiltFor, as_scene, of_known_numbers, shown_from_users_lines, warn
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import structure_whatever_its_faults


@dataclass(frozen=True, repr=False)
class Checked(Printed):
    """Findings of `check`: likely mistakes in words, by subject. `print` shows a table."""

    scene: str
    found: dict[str, tuple[str, ...]]

    @property
    def passed(self) -> bool:
        """Return whether there are no findings."""
        return not any(self.found.values())

    def _text(self) -> str:
        rows = [f"  {what:<16} {'; '.join(sentences) or 'ok'}" for what, sentences in self.found.items()]
        return "\n".join(
            [f"Check of {self.scene}: {'nothing looks wrong' if self.passed else 'LOOK AT THIS'}", *rows]
        )


@shown_from_users_lines
@of_known_numbers
def check(scene: Scene | BuiltFor) -> Checked:
    """Check a scene for likely mistakes: kinks and jumps, grounds carried by other bodies, bodies with
    impossible inertia, a scalar program that differs from JAX.

        print(jj.check(scene))

    The check samples states of the domain, so it may miss a narrow feature between them. `verify` also
    prints this table, and the first `build` of a class issues it as a warning. Building or moving the scene
    raises the first finding as an error, except for a program that differs (dense matrices replace it).
    Raises ValueError if there is no admissible state, or if a free motion has no inertia.
    """
    return _checked(as_scene(scene), None)


def _checked(scene: Scene, every_speed: bool | None) -> Checked:
    """Return the findings; `every_speed` selects the program to compare, as in `lowered`."""
    known = structure_whatever_its_faults(scene)
    program = "" if known.kinks or known.odd_grounds or known.faults else lowered(scene, every_speed)
    found = {
        "smoothness": known.kinks,
        "grounds": known.odd_grounds,
        "bodies": known.faults or known.impossible,
        "scalar program": (
            (str(program),) if isinstance(program, NotLowered) and DIFFERS in str(program) else ()
        ),
    }
    return Checked(type(scene).__name__, found)


@once_per_class
def warn_of_mistakes(scene: Scene, every_speed: bool) -> None:
    """Issue the table as a warning if there are findings, once per class and state."""
    if not (found := _checked(scene, every_speed)).passed:
        warn(str(found))
