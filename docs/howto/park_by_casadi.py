"""Park a car with a trailer: the fastest way that IPOPT finds through CasADi."""

import casadi
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj


class CarWithTrailer(jj.Scene):
    base: float = 2.6  # m, between the axles of the car; the hitch is at the rear one
    length: float = 3.0  # m, from the hitch to the axle of the trailer
    coordinates = jj.coordinates("x y heading steer trailer")
    inputs = jj.inputs("drive steer_torque")
    privileged = ("x_rate", "steer_rate")
    domain = {"heading": (-1.2, 1.2), "steer": (-0.7, 0.7), "trailer": (-1.2, 1.2)}

    def bodies(self, t, q):
        car, behind, rear = jj.rot_z(q.heading), jj.rot_z(q.trailer), jj.vec(q.x, q.y, 0)
        front, axle = rear + self.base * car[:, 0], rear - self.length * behind[:, 0]
        return {
            "car": jj.RigidBody(900.0, 1200.0 * jnp.ones(3), rear, car),
            "front": jj.RigidBody(30.0, jnp.ones(3), front, car @ jj.rot_z(q.steer)),
            "trailer": jj.RigidBody(300.0, 200.0 * jnp.ones(3), axle, behind),
        }

    def velocity_constraints(self, motion):  # no wheel slips sideways
        return {
            name: jj.knife_edge(body, body.position, body.orientation[:, 1])
            for name, body in motion.bodies.items()
        }

    def loads(self, motion):
        push = motion.inputs.drive * motion["car"].orientation[:, 0]
        torque = jj.generalized_force(motion, steer_rate=motion.inputs.steer_torque)
        return jj.point_force(motion["car"].point(), push), torque


car = CarWithTrailer()
lowered, program = jj.lower(car), {}
exec(lowered.python_source(), program)
program["math"] = casadi
fixed = program["fixed"](float(car.base), float(car.length))


def rates(x, f):  # of coordinates and independent speeds
    return casadi.vertcat(*program["rates"](fixed, 0.0, *casadi.vertsplit(x), *casadi.vertsplit(f)))


n, size = 100, casadi.DM([1000.0, 100.0])  # N, N m
task = casadi.Opti()
x, f, T = task.variable(7, n + 1), task.variable(2, n + 1), task.variable()
h = T / n
for k in range(n):
    a, b, f_a, f_b = x[:, k], x[:, k + 1], size * f[:, k], size * f[:, k + 1]
    r_a, r_b = rates(a, f_a), rates(b, f_b)
    middle = rates((a + b) / 2 + h / 8 * (r_a - r_b), (f_a + f_b) / 2)
    task.subject_to(b == a + h / 6 * (r_a + 4 * middle + r_b))
task.subject_to(x[:, 0] == np.zeros(7))
task.subject_to(x[:, n] == [0, -2.5, 0, 0, 0, 0, 0])
for part, reach in ((x[3, :], 0.6), (x[4, :] - x[2, :], 0.7), (casadi.vec(f), 1.0)):
    task.subject_to(task.bounded(-reach, part, reach))  # steer, trailer against car, forces
task.subject_to(T >= 5.0)
guess = np.stack([6.0 * np.sin(np.linspace(0, np.pi, n + 1)), np.linspace(0, -2.5, n + 1)])
task.set_initial(x[:2, :], guess)  # ahead and back
task.set_initial(x[5, :], np.gradient(guess[0], 20.0 / n))
task.set_initial(T, 20.0)
task.minimize(T + 10.0 * h * casadi.sumsqr(f))
task.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
parked = task.solve()
print(parked.stats()["return_status"], parked.stats()["iter_count"], f"iterations, {parked.value(T):.2f} s")

end = parked.value(T)
ts = np.linspace(0.0, end, n + 1)
forces = np.diag([1000.0, 100.0]) @ parked.value(f)
inputs = {"drive": jj.Sampled(ts, forces[0]), "steer_torque": jj.Sampled(ts, forces[1])}
motion = jj.simulate(car, {"x": 0.0}, ts=ts, inputs=inputs)
print(np.asarray(motion.q[-1]).round(3))
