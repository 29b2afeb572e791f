"""Files that are not what they say: whatever entry is taken away, or changed, is named; and an old file stays until a new one is whole."""

import json
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_inputs import OnBelt
from test_storage import assert_equal_to_the_bit

import jourdain_jax as jj

TS = np.linspace(0.0, 0.2, 3)
INPUTS = {"speed": 1.0, "push": 0.5}
INFORMATIVE = ("versions",)  # read by people only


class Belt(OnBelt):
    """With a parameter that has a default, which must not stand in for what moved, and a count."""

    drag: jnp.ndarray = jj.parameter(0.0, unit="N s/m")
    sides: int = eqx.field(static=True, default=2)

    def loads(self, motion):
        return (jj.generalized_force(motion, y_rate=motion.inputs.push - self.drag * motion.u.y_rate),)


@pytest.fixture(scope="module")
def motions():
    alone = jj.simulate(Belt(drag=0.3, sides=3), {"y": 0.1}, ts=TS, inputs=INPUTS)
    lanes = jj.rollout(Belt(sides=3), {"y": 0.1}, parameters={"drag": np.array([0.3, 0.4])}, ts=TS, inputs=INPUTS, progress=False)
    return {"trajectory": alone, "rollout": lanes}


READ = {"trajectory": jj.load_trajectory, "rollout": jj.load_rollout}


def rewritten(path, new, arrays=None, header=None):
    """The file with arrays and entries of the header changed, or left out where None."""
    with np.load(path) as file:
        kept = {name: file[name] for name in file.files}
    head = json.loads(str(kept.pop("header"))) | (header or {})
    kept |= {"header": np.array(json.dumps({name: value for name, value in head.items() if value is not None}))} | (arrays or {})
    np.savez(new, **{name: value for name, value in kept.items() if value is not None})
    return new


@pytest.fixture(scope="module", params=READ)
def saved(request, motions, tmp_path_factory):
    path = tmp_path_factory.mktemp("faults") / f"{request.param}.npz"
    jj.save(motions[request.param], path)
    return request.param, motions[request.param], path


def _contents(path):
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays, json.loads(str(arrays.pop("header")))


def spoilt_arrays(arrays):
    """What may have happened to each array, and what is then wrong with it."""
    for name, x in arrays.items():
        yield f"{name} removed", {name: None}
        yield f"{name} with an axis more", {name: x[..., None]}
        if x.ndim and x.size:
            yield f"{name} cut short", {name: x[..., :-1]}
            yield f"{name} of fewer", {name: x[:-1]}
            yield f"{name} doubled", {name: np.concatenate([x, x])}
            yield f"{name} without its first axis", {name: x[0]}
        yield f"{name} complex", {name: x + 1j}
        yield f"{name} as text", {name: x.astype(str)}
        if x.dtype.kind == "f":
            yield f"{name} whole numbers", {name: np.zeros(x.shape, int)}
            yield f"{name} not finite", {name: np.full(x.shape, np.nan)}
        elif x.size:
            yield f"{name} with a fraction", {name: x + 0.5}
            yield f"{name} out of range", {name: x + 1000}
            yield f"{name} negative", {name: x - 1000}


def spoilt_headers(header):
    for name, value in header.items():
        yield f"{name} removed", {name: None}
        for other in (3.5, "something", [1, 2], {"a": 1}, ["a", "b", "c", "d"], True):
            if type(other) is not type(value) or other != value:
                yield f"{name} as {other!r}", {name: other}


def _is_as_it_was(read, motion, allowed):
    """Whether what was read is the motion but for what may be absent or is of no account to it."""
    a, b = (jax.tree.leaves((m.lanes if isinstance(m, jj.Rollout) else m).scene) for m in (read, motion))
    same = all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    states = [np.array_equal((read.lanes if isinstance(read, jj.Rollout) else read).q, (motion.lanes if isinstance(motion, jj.Rollout) else motion).q)]
    return allowed and same and all(states)


def test_whatever_happens_to_an_array_is_noticed(saved, tmp_path):
    kind, _, path = saved
    arrays, _ = _contents(path)
    silent = []
    for k, (what, change) in enumerate(spoilt_arrays(arrays)):
        new = rewritten(path, tmp_path / f"{k}.npz", change)
        name = what.split()[0]
        may_be = name in ("last_step", "smallest_pivot") and "not finite" in what
        if name.startswith(("accepted", "rejected", "crossings")) and "range" in what:
            may_be = True  # a count as good as another
        if name.startswith("parameter") and "whole" in what:
            may_be = name == "parameter:drag"  # zero is a drag
        try:
            READ[kind](new, Belt)
            silent += [] if may_be else [what]
        except ValueError as error:
            silent += [] if str(new) in str(error) or "parameter `" in str(error) else [f"{what}: {error}"]
    assert not silent


def test_whatever_happens_to_an_entry_of_the_header_is_noticed(saved, tmp_path):
    kind, motion, path = saved
    _, header = _contents(path)
    silent = []
    for k, (what, change) in enumerate(spoilt_headers(header)):
        new, name = rewritten(path, tmp_path / f"{k}.npz", header=change), what.split()[0]
        try:
            read = READ[kind](new, Belt)
            labels = name in ("arrays", "reduction", "solver", "projected", "unwatched", "event_names", "state_form")
            allowed = name in INFORMATIVE or labels
            silent += [] if _is_as_it_was(read, motion, allowed) else [what]
        except ValueError as error:
            silent += [] if str(new) in str(error) or "the file holds" in str(error) else [f"{what}: {error}"]
    assert not silent


def test_a_parameter_that_the_file_lacks_is_not_the_default(saved, tmp_path):
    kind, _, path = saved
    new = rewritten(path, tmp_path / "less.npz", {"parameter:drag": None})
    with pytest.raises(ValueError, match="lacks the parameter `drag` of `Belt`"):
        READ[kind](new, Belt)
    new = rewritten(path, tmp_path / "count.npz", header={"static": {}})
    with pytest.raises(ValueError, match="lacks the parameter `sides` of `Belt`"):
        READ[kind](new, Belt)


def test_a_parameter_whose_unit_changed_since_is_named(saved, tmp_path):
    kind, _, path = saved
    new = rewritten(path, tmp_path / "units.npz", header={"units": {"drag": "N s/mm"}})
    with pytest.raises(ValueError, match="the parameter `drag` in N s/mm, but `Belt` takes it in N s/m; pass the class as it was"):
        READ[kind](new, Belt)


def test_a_file_read_back_is_the_motion_to_the_bit(motions, tmp_path):
    lanes = motions["rollout"]
    jj.save(lanes, tmp_path / "lanes.npz")
    read = jj.load_rollout(tmp_path / "lanes.npz", Belt)
    for a, b in ((read.lanes.q, lanes.lanes.q), (read.lanes.u_end, lanes.lanes.u_end), (read.lanes.scene.drag, lanes.lanes.scene.drag)):
        assert_equal_to_the_bit(a, b)


@pytest.mark.parametrize("stage", ["savez_compressed", "fsync", "replace"])
def test_an_interrupted_save_leaves_the_old_file_and_nothing_else(motions, tmp_path, monkeypatch, stage):
    path = tmp_path / "kept.npz"
    jj.save(motions["trajectory"], path)
    before = path.read_bytes()

    def interrupted(*args, **kwargs):
        if stage == "savez_compressed":
            args[0].write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(np if stage == "savez_compressed" else os, stage, interrupted)
    with pytest.raises(KeyboardInterrupt):
        jj.save(motions["trajectory"], path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["kept.npz"]
    jj.save(motions["trajectory"], path)
    jj.load_trajectory(path, Belt)
    (tmp_path / "link.npz").symlink_to(path)
    jj.save(motions["trajectory"], tmp_path / "link.npz")
    assert (tmp_path / "link.npz").is_symlink()
    assert len(list(tmp_path.iterdir())) == 2
