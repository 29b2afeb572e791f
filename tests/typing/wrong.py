"""A mistake in each line that ends in `wrong`."""

import jourdain_jax as jj

disc = jj.models.TiltingDisc(mass=1.0)
motion = jj.simulate(disc, {"lean": 0.3}, t1=1.0)


class Fallen(jj.Scene):
    mass: float = jj.parameter(1.3, unit="kg", positive=True)
    coordinates = jj.coordinates("x y heading")

    def loads(self, motion):
        return (jj.gravity(motion, 9.81 * self.mas),)  # wrong


jj.models.TiltingDisc(mas=1.0)  # wrong
jj.models.TiltingDsc()  # wrong
Fallen(weight=1.0)  # wrong
jj.parameter(1.3, units="kg")  # wrong
print(disc.replace(mass=2.0).mas)  # wrong
jj.simulat(disc, {}, t1=1.0)  # wrong
jj.simulate(disc, {}, t2=1.0)  # wrong
jj.simulate(disc, {}, t1="1")  # wrong
print(motion.q_ends)  # wrong
jj.rollout(disc, {}, t1=1.0, rtoll=1e-6)  # wrong
jj.fit(disc, [], fre={"mass": None})  # wrong
jj.Study(disc).run("study.zarr", save_as="statistics")  # wrong
