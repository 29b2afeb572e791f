"""A kick scooter whose rider stands still: a Whipple bicycle with small wheels and a low deck, pushed from
behind.

Straight and upright, a push F accelerates it by F / (m + I_R/r_R^2 + I_F/r_F^2). At 1 to 3 m/s it falls
unless the rider steers. Source of the equations: J. P. Meijaard et al., Proc. R. Soc. A 463 (2007) 1955; the
parameters are estimates for an adult's scooter.
"""

import jourdain_jax as jj

LOOK = (
    "After one kick nobody steers. At this speed the front wheel turns into the fall too late, and the lean"
    " grows."
)


class KickScooter(jj.models.WhippleBicycle):
    """The Whipple bicycle with the parameters of a scooter. Inputs: those of the bicycle, and `push`, the
    forward force on the deck from the foot on the ground (N).
    """

    w: float = jj.parameter(0.86, unit="m", positive=True, about="wheelbase")
    c: float = jj.parameter(0.03, unit="m", about="trail")
    lam: float = jj.parameter(0.21, unit="rad", about="steer axis tilt")
    rR: float = jj.parameter(0.10, unit="m", positive=True, about="rear wheel radius")
    rF: float = jj.parameter(0.10, unit="m", positive=True, about="front wheel radius")
    mR: float = jj.parameter(0.6, unit="kg", positive=True, about="rear wheel mass")
    mF: float = jj.parameter(0.6, unit="kg", positive=True, about="front wheel mass")
    IRxx: float = jj.parameter(0.0018, unit="kg m^2", non_negative=True)
    IRyy: float = jj.parameter(0.0035, unit="kg m^2", non_negative=True)
    IFxx: float = jj.parameter(0.0018, unit="kg m^2", non_negative=True)
    IFyy: float = jj.parameter(0.0035, unit="kg m^2", non_negative=True)
    xB: float = jj.parameter(0.35, unit="m", about="deck and rider, forward")
    zB: float = jj.parameter(-0.95, unit="m", about="deck and rider, down")
    mB: float = jj.parameter(78.0, unit="kg", positive=True)
    IBxx: float = jj.parameter(15.0, unit="kg m^2", non_negative=True)
    IByy: float = jj.parameter(15.5, unit="kg m^2", non_negative=True)
    IBzz: float = jj.parameter(1.2, unit="kg m^2", non_negative=True)
    IBxz: float = jj.parameter(0.5, unit="kg m^2")
    xH: float = jj.parameter(0.76, unit="m")
    zH: float = jj.parameter(-0.55, unit="m")
    mH: float = jj.parameter(2.0, unit="kg", positive=True)
    IHxx: float = jj.parameter(0.18, unit="kg m^2", non_negative=True)
    IHyy: float = jj.parameter(0.18, unit="kg m^2", non_negative=True)
    IHzz: float = jj.parameter(0.012, unit="kg m^2", non_negative=True)
    IHxz: float = jj.parameter(-0.03, unit="kg m^2")

    inputs = jj.inputs("lean_torque steer_torque push")
    example = {"rear_spin_rate": 30.0, "lean_rate": 0.02}
    example_span = 1.6

    def visuals(self, pose):
        return {
            "rear frame": jj.Visual.line(*RIDER, radius=0.03),
            "front frame": jj.Visual.line(*FORK, radius=0.02),
        }

    def loads(self, motion):
        deck = motion["rear frame"]
        foot = deck.point(
            (-self.xB, 0.0, self.zB + self.rR)
        )  # behind the rider, at the height of the rear axle
        return *super().loads(motion), jj.point_force(foot, motion.inputs.push * deck.orientation[:, 0])

    def effective_mass(self):
        """What a push has to move when the scooter runs straight: all masses and the turning of the wheels
        (kg).
        """
        return self.mR + self.mB + self.mH + self.mF + self.IRyy / self.rR**2 + self.IFyy / self.rF**2


# for drawing only, m: hub, deck, leg, trunk, head, arm; and the fork with its handlebar
RIDER = (
    (-0.35, 0.0, -0.85), (-0.2, 0.0, -0.87), (0.45, 0.0, -0.8), (0.0, 0.0, -0.85), (0.0, 0.0, 0.05),
    (0.08, 0.0, 0.45), (0.08, 0.0, 0.65), (0.08, 0.0, 0.4), (0.34, 0.0, 0.0),
)  # fmt: skip
FORK = ((0.1, 0.0, -0.45), (-0.07, 0.0, 0.4), (-0.07, 0.22, 0.4), (-0.07, -0.22, 0.4))
