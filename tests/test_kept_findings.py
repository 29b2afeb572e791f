"""What is found of a scene, kept on disk between processes."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.build import kept_findings, sampling, structure
from jourdain_jax.calculus.plain_text import as_text, from_text
from jourdain_jax.lowering import kept_programs, lower
from jourdain_jax.models import MODELS

name_of = kept_findings.name_of  # as it is when no test has begun


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr(kept_findings, "name_of", name_of)
    return tmp_path / "kept"


def _never(*_):
    raise AssertionError("found again")


def _program(scene) -> tuple:
    known = structure._structure.__wrapped__(scene)
    key = lower._Key.of(scene, known, not known.has_minimal_state or not known.row_names, known.massless and bool(known.row_names))
    found = lower._built_or_kept(key)
    *graph, told = from_text(kept_programs.program_as_text(found))
    return as_text(vars(known)), as_text(graph), {name: as_text(value) for name, value in told.items() if name != "seconds"}


@pytest.mark.parametrize("name", MODELS)
def test_structure_and_program_are_the_same_when_they_are_read(folder, monkeypatch, name):
    found = _program(MODELS[name]())
    monkeypatch.setattr(lower, "_built", _never)
    monkeypatch.setattr(structure, "_probed_structure", _never)
    assert _program(MODELS[name]()) == found
    assert {file.name.partition("_")[0] for file in folder.iterdir()} == {"program", "structure"}


def test_a_program_is_the_same_whether_anything_is_kept_or_not(folder, monkeypatch):
    kept = _program(MODELS["tilting-disc"]())
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", "0")
    assert _program(MODELS["tilting-disc"]()) == kept


def test_a_torn_file_is_made_again(folder, monkeypatch):
    found = _program(MODELS["vertical-disc"]())
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes()[:-5])
    assert _program(MODELS["vertical-disc"]()) == found


def _scene(weight=1.0, bounds=(-1.0, 1.0), name="Bead", row="floor", push=None, unit="kg", span=5.0, privileged=None):
    def bodies(self, t, q):
        return {"bead": jj.Particle(mass=self.mass, position=jnp.stack([q.x, q.y, 0.0]))}

    def loads(self, motion):
        force = jnp.zeros(3) if push is None else push(motion)
        return (jj.gravity(motion, weight), jj.point_force(motion["bead"].point(np.zeros(3)), force))

    members = {
        "__annotations__": {"mass": float},
        "mass": jj.parameter(2.0, unit=unit),
        "coordinates": jj.coordinates("x y"),
        "domain": {"x": bounds},
        "example_span": span,
        "privileged": privileged,
        "bodies": bodies,
        "loads": loads,
        "velocity_constraints": lambda self, motion: {row: motion.u.y_rate - motion.u.x_rate},
    }
    return type(name, (jj.Scene,), members)()


def _name(scene) -> str | None:
    return name_of("structure", scene, (), ())


def test_the_name_tells_scenes_from_each_other(monkeypatch):
    first = _name(_scene())
    assert first == _name(_scene())
    others = [{"weight": 1.5}, {"bounds": (-1.0, 2.0)}, {"name": "Pearl"}, {"row": "wall"}, {"unit": "g"}, {"span": 4.0}, {"privileged": ("x_rate",)}]
    others += [{"push": lambda motion: motion.t * jnp.ones(3)}]
    names = [_name(_scene(**other)) for other in others] + [
        _name(_scene().replace(mass=3.0)),
        name_of("program", _scene(), (), ()),
        name_of("structure", _scene(), (), (1,)),
    ]
    monkeypatch.setattr(kept_findings, "_source", lambda: b"changed")
    names += [_name(_scene())]
    assert None not in names
    assert len({first, *names}) == 1 + len(names)


def test_a_configuration_that_was_seen_is_part_of_the_name(monkeypatch):
    scene = _scene()
    before = _name(scene)
    monkeypatch.setitem(sampling._seen, type(scene), np.array([0.1, 0.2]))
    assert _name(scene) != before


def test_what_no_digest_can_tell_has_no_name(folder):
    def printed(motion):
        jax.debug.print("{}", motion.t)
        return jnp.zeros(3)

    @jax.custom_jvp
    def own(t):
        return t * jnp.ones(3)

    own.defjvp(lambda x, dx: (own(*x), 2 * dx[0] * jnp.ones(3)))
    for push in (printed, lambda motion: own(motion.t)):
        assert _name(_scene(push=push)) is None
    assert kept_findings.kept_of_scene("structure", _scene(push=printed), lambda: b"found") == b"found"
    assert not folder.exists()


def test_another_process_gives_the_same_name():
    program = "import jourdain_jax as jj; from jourdain_jax.build.kept_findings import name_of; print(name_of('a', jj.models.TiltingDisc(), (), ()))"
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | {"PYTHONHASHSEED": "7"}, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == name_of("a", jj.models.TiltingDisc(), (), ())


def test_text_keeps_every_digit():
    value = {"a": (0.1, -0.0, float("inf"), None, True), 3: np.arange(6.0).reshape(2, 3) / 7, "none": np.zeros((0, 2), np.float32)}
    back = from_text(as_text(value))
    assert as_text(back) == as_text(value)
    assert back["none"].shape == (0, 2)
    assert back["none"].dtype == np.float32
    assert np.signbit(back["a"][1])
