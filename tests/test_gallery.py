"""One checkable fact of each scene of `docs/gallery/scenes`, and the pages that `docs/make_gallery.py`
writes.
"""

import ast
import importlib
import re
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax.equations import constraint_rows

DOCS = Path(__file__).parents[1] / "docs"
NAMES = sorted(path.stem for path in (DOCS / "gallery" / "scenes").glob("*.py"))
G = 9.81


@pytest.fixture(scope="module", autouse=True)
def _gallery_can_be_imported():
    sys.path[:0] = [str(DOCS), str(DOCS / "gallery")]
    yield
    for path in (DOCS, DOCS / "gallery"):
        sys.path.remove(str(path))


def scene_of(name, **parameters):
    """The scene in the file of this name."""
    module = importlib.import_module(f"scenes.{name}")
    kinds = [
        kind
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, jj.Scene) and kind.__module__ == module.__name__
    ]
    assert len(kinds) == 1
    return kinds[0](**parameters)


def among(expected, found):
    """Every expected eigenvalue (1/s) is found."""
    for value in expected:
        assert np.abs(np.asarray(found) - value).min() < 1e-8 * max(1.0, abs(value)), (value, found)


def box(mass, sides):
    """Central moments of a uniform box, kg m^2."""
    a, b, c = np.square(sides)
    return mass / 12 * np.array([b + c, a + c, a + b])


def test_a_trailer_hitched_behind_the_axle_runs_on_the_circle_of_the_closed_form():
    robot = scene_of("robot_with_trailer")
    hitch, tongue, speed, turn = 0.2, 0.6, 0.1 * 6.0, 0.1 * 2.0 / 0.36
    radius = speed / turn
    behind = np.sqrt(radius**2 + hitch**2 - tongue**2)
    start = jj.start(
        robot, left_rate=5.0, right_rate=7.0, trailer=-np.arctan2(hitch, radius) - np.arctan2(tongue, behind)
    )
    trailer = jj.motion_at(robot, 0.0, start.q, start.u)["trailer"]
    assert_allclose(
        [start["heading_rate"], start["trailer_rate"]], turn, rtol=1e-12
    )  # it turns as fast as the robot: steady
    assert_allclose(np.linalg.norm(trailer.velocity), turn * behind, rtol=1e-12)


def test_the_rows_of_both_steered_wheels_of_a_car_agree_to_round_off():
    car = scene_of("car_with_trailers")
    start = jj.start(car, x_rate=3.0, steer=0.35, steer_rate=0.2, heading=0.4)
    A = constraint_rows(car, 0.0, start.q, start.u).A
    singular = np.linalg.svd(A, compute_uv=False)
    assert A.shape[0] == car.trailers + 3
    assert singular[-1] < 1e-15 < 0.1 < singular[-2]


def test_a_tricycle_turns_its_wheels_by_their_radii_and_carries_by_its_lever():
    tricycle = scene_of("tricycle")
    start = jj.start(tricycle, steer=0.5, front_rate=6.0)
    turn = 6.0 * 0.2 / np.hypot(1.1 / np.tan(0.5), 1.1)  # rad/s
    wheels = [turn * (1.1 / np.tan(0.5) + side * 0.4) / 0.2 for side in (-1, 1)]
    assert_allclose(
        [start["heading_rate"], start["left_rate"], start["right_rate"]], [turn, *wheels], rtol=1e-12
    )


def test_a_push_moves_a_scooter_by_its_masses_and_the_turning_of_its_wheels():
    scooter = scene_of("kick_scooter")
    start = jj.start(scooter, **scooter.upright(3.0))
    found = jj.accelerations(scooter, 0.0, start.q, start.u, {"push": 100.0})
    rates = dict(zip(scooter.speed_names.entries, found.udot, strict=True))
    assert_allclose(rates["x_rate"], 100.0 / scooter.effective_mass(), rtol=1e-12)
    assert_allclose(rates["front_spin_rate"], rates["x_rate"] / 0.1, rtol=1e-12)


def test_a_unicycle_leans_and_pitches_by_the_eigenvalues_of_the_closed_form():
    unicycle = scene_of("unicycle", pitch_gain=0.0, rate_gain=0.0)
    m, r, rider, h = 8.0, 0.35, 20.0, 0.5
    rim, inertia = m * r**2, np.array([1.2, 1.2, 0.3])
    lever, about_line = m * r + rider * (r + h), m * r**2 + rim / 2 + rider * (r + h) ** 2 + inertia[0]
    for spin in (3.0, 8.0):
        found = jj.linearize(unicycle, jj.start(unicycle, spin_rate=spin)).eigenvalues()
        lean = np.sqrt(
            complex((lever * G - (rim + lever * r) * rim * spin**2 / (rim / 2 + inertia[2])) / about_line)
        )
        pitch = np.sqrt(
            rider * G * h / (rider * h**2 + inertia[1] - (rider * h * r) ** 2 / ((m + rider) * r**2 + rim))
        )
        among([lean, -lean, pitch, -pitch], found)
        assert (lean.real > 0.1) == (spin < 4.45)  # the critical spin


def test_a_ball_at_rest_on_a_free_plate_sets_off_as_in_the_closed_form():
    plate = scene_of("ball_on_plate", stiffness=0.0, damping=0.0)
    J, m, r, x, tilt = 0.05, 0.3, 0.03, 0.12, 0.3
    start = jj.start(plate, x=x, pitch=tilt)
    rates = dict(
        zip(plate.speed_names.entries, jj.accelerations(plate, 0.0, start.q, start.u).udot, strict=True)
    )
    # 7/5 m r^2 s'' = m g r sin(a),   (J + m x^2) a'' = m g x cos(a),   x = r (s - a)
    pitch = m * G * x * np.cos(tilt) / (J + m * x**2)
    assert_allclose(rates["pitch_rate"], pitch, rtol=1e-12)
    assert_allclose(rates["x_rate"], 5 / 7 * G * np.sin(tilt) - r * pitch, rtol=1e-12)


def test_the_pendulum_of_a_spherical_robot_swings_at_the_frequency_of_the_closed_form():
    robot = scene_of("spherical_robot")
    M, r, m, length, J = 1.0, 0.15, 1.5, 0.08, 1e-3
    rate = np.sqrt(
        m * G * length / (m * length**2 + J - (m * r * length) ** 2 / ((M + m) * r**2 + 2 / 3 * M * r**2))
    )
    among([1j * rate, -1j * rate], jj.linearize(robot, {}).state_eigenvalues())


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_a_roller_racer_straightens_forwards_and_folds_backwards(speed):
    racer = scene_of("roller_racer", stiffness=0.0, damping=0.0)
    I1, I2, a, b = 1.5, 0.05, 0.6, 0.1
    among(
        [-speed * (I1 * b + I2 * a) / (I1 * b**2 + I2 * a**2)],
        jj.linearize(racer, {"x_rate": speed}).state_eigenvalues(),
    )


def test_a_two_wheeled_pendulum_falls_at_the_rate_of_the_closed_form():
    pendulum = scene_of("two_wheeled_pendulum", pitch_gain=0.0, rate_gain=0.0, speed_gain=0.0)
    m, h, wheel, r = 40.0, 0.6, 3.0, 0.2
    J = box(m, (0.2, 0.4, 1.0))[1]
    rate = np.sqrt(m * G * h / (m * h**2 + J - (m * h * r) ** 2 / ((m + 2 * wheel) * r**2 + wheel * r**2)))
    among([rate, -rate], jj.linearize(pendulum, {}).state_eigenvalues())


def test_driven_wheels_leave_the_angular_momentum_of_a_satellite():
    satellite = scene_of("satellite")
    drive = {
        "torque_x": lambda t: 0.4 * jnp.sin(t),
        "torque_y": lambda t: -0.3 * jnp.cos(2.0 * t),
        "torque_z": 0.1,
    }
    motion = jj.simulate(
        satellite, jj.start(satellite, **satellite.example), t1=5.0, rtol=1e-11, atol=1e-11, inputs=drive
    )
    assert jnp.abs(motion["attitude_x"][-1]) > 0.02  # it has turned
    for name, values in motion.invariants().items():
        assert_allclose(values, values[0], atol=1e-9, err_msg=name)


def maker():
    """The script that writes the pages."""
    return importlib.import_module("make_gallery")


def ink(path):
    """The part of a picture's pixels that are not white."""
    import matplotlib.image

    return float(np.mean(np.any(matplotlib.image.imread(path)[..., :3] < 0.98, axis=-1)))


def test_every_page_draws_the_picture_that_it_shows(tmp_path):
    make = maker()
    pages = make.entries()
    assert len(pages) == len(NAMES) + len(jj.models.MODELS) >= 20 + 10
    assert set(make.SCENE_PICTURES) == set(NAMES)
    assert set(make.MODEL_PICTURES) == set(jj.models.MODELS)
    for name, entry in pages.items():
        text = make.page_of(entry, tmp_path)
        code = text.partition("```python\n")[2].partition("```")[0]
        ast.parse(code)
        assert f"({name}.png)" in text
        assert f'"{name}.png"' in code
        assert entry.look
        assert "**What to look at.**" in text
        assert (tmp_path / re.search(r"Source: \[.*\]\((.*)\)", text)[1]).resolve() == entry.source


def written(tmp_path, *names):
    """Pages and index of these names are there, with pictures that show something."""
    maker().main(["--out", str(tmp_path), *names])
    index = (tmp_path / "index.md").read_text()
    for name in names or maker().entries():
        assert (tmp_path / f"{name}.md").read_text().startswith("# ")
        assert ink(tmp_path / f"{name}.png") > 0.02, name
        assert f":img-top: {name}.png" in index
        assert f"\n{name}\n" in index.partition("{toctree}")[2]


def test_pages_are_written_with_pictures_that_show_something(tmp_path):
    written(tmp_path, "isokinetic-particle", "vertical-disc")


def test_all_pages_are_written_with_pictures_that_show_something(tmp_path):
    written(tmp_path)


def test_an_unknown_page_is_refused_with_the_names_of_all(tmp_path, capsys):
    with pytest.raises(SystemExit):
        maker().main(["--out", str(tmp_path), "unicycles"])
    assert "no page `unicycles`, expected some of: ball-on-plate" in capsys.readouterr().err
