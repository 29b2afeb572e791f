"""Guesses at mistakes of a scene, in one table: what can be computed, but is hardly meant.

smoothness        poses, rows and rates of coordinates that jump, or whose velocities do, on lines through states of the domain
grounds           what the ground of a contact does, and what is stated of it
bodies            0 <= I_1 <= I_2 <= I_3 <= I_1 + I_2, and all that is refused where a motion starts
scalar program    its rates and slopes against JAX's
"""

from dataclasses import dataclass

from jourdain_jax.build.plausibility import impossible_bodies
from jourdain_jax.build.structure import structure_whatever_its_faults
from jourdain_jax.lowering.comparison import DIFFERS
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered import NotLowered
from jourdain_jax.scene.arguments import BuiltFor, as_scene, of_known_numbers
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import shown_from_users_lines


@dataclass(frozen=True, repr=False)
class Checked(Printed):
    """What was looked at of a scene -> what looks wrong there, in sentences; nothing where all is plausible. `print` shows it as a table."""

    scene: str
    found: dict[str, tuple[str, ...]]

    @property
    def passed(self) -> bool:
        """Whether nothing looks wrong."""
        return not any(self.found.values())

    def _text(self) -> str:
        rows = [f"  {what:<16} {'; '.join(sentences) or 'ok'}" for what, sentences in self.found.items()]
        return "\n".join([f"Check of {self.scene}: {'nothing looks wrong' if self.passed else 'LOOK AT THIS'}", *rows])


@shown_from_users_lines
@of_known_numbers
def check(scene: Scene | BuiltFor) -> Checked:
    """Guess at mistakes of a scene: kinks and jumps, grounds that other bodies carry, bodies that cannot be, a program that differs from JAX.

        print(jj.check(scene))

    All findings at once, of some states of the domain: what lies between these, and is narrow, is not seen. The first of them is an error where the scene is
    built or moves, but for a program that differs (dense matrices are taken), and moments of inertia of which the largest exceeds the sum of the others.
    ValueError where no admissible state is found, or a motion that the rows leave free has no inertia.
    """
    scene = as_scene(scene)
    known = structure_whatever_its_faults(scene)
    program = "" if known.kinks or known.odd_grounds or known.faults else lowered(scene)
    found = {
        "smoothness": known.kinks,
        "grounds": known.odd_grounds,
        "bodies": known.faults or impossible_bodies(scene, known.coordinates[0]),
        "scalar program": (str(program),) if isinstance(program, NotLowered) and DIFFERS in str(program) else (),
    }
    return Checked(type(scene).__name__, found)
