"""Files that are not what they say: whatever entry is taken away, or changed, is named; and an old file stays
until a new one is whole.
"""

import io
import json
import os
import zipfile

import equinox as eqx
import jax
import numpy as np
import pytest
from refusals import refused
from test_inputs import OnBelt

import jourdain_jax as jj

TS = np.linspace(0.0, 0.2, 3)
INPUTS = {"speed": 1.0, "push": 0.5}


class Belt(OnBelt):
    """With a parameter that has a default, which must not stand in for what moved, and a count."""

    drag: float = jj.parameter(0.0, unit="N s/m")
    sides: int = eqx.field(static=True, default=2)

    def loads(self, motion):
        return jj.generalized_force(motion, y_rate=motion.inputs.push - self.drag * motion.u.y_rate)


@pytest.fixture(scope="module")
def motions():
    start, given = {"y": 0.1}, {"ts": TS, "inputs": INPUTS}
    alone = jj.simulate(Belt(drag=0.3, sides=3), start, **given)
    lanes = jj.rollout(Belt(sides=3), start, parameters={"drag": np.array([0.3, 0.4])}, **given)
    return {"trajectory": alone, "rollout": lanes}


READ = {"trajectory": jj.load_trajectory, "rollout": jj.load_rollout}


def rewritten(path, new, arrays=None, header=None):
    """The file with arrays and entries of the header changed, or left out where None."""
    given = lambda entries: {name: value for name, value in entries.items() if value is not None}
    held, head = _contents(path)
    text = np.array(json.dumps(given(head | (header or {}))))
    np.savez(new, **given(held | {"header": text} | (arrays or {})))
    return new


@pytest.fixture(scope="module", params=READ)
def saved(request, motions, tmp_path_factory):
    path = tmp_path_factory.mktemp("faults") / f"{request.param}.npz"
    jj.save(motions[request.param], path)
    return lambda file: READ[request.param](file, Belt), motions[request.param], path


def _contents(path):
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays, json.loads(str(arrays.pop("header")))


def spoilt_arrays(arrays):
    """What may have happened to each array, and what is then wrong with it."""
    for name, x in arrays.items():
        made = {
            "removed": None,
            "with an axis more": x[..., None],
            "complex": x + 1j,
            "as text": x.astype(str),
        }
        if x.ndim and x.size:
            made |= {"cut short": x[..., :-1], "of fewer": x[:-1], "doubled": np.concatenate([x, x])}
            made |= {"without its first axis": x[0]}
        if x.dtype.kind == "f":
            made |= {"whole numbers": np.zeros(x.shape, int), "not finite": np.full(x.shape, np.nan)}
        elif x.size:
            made |= {"with a fraction": x + 0.5, "out of range": x + 1000, "negative": x - 1000}
        yield from ((f"{name} {what}", {name: y}) for what, y in made.items())


def spoilt_headers(header):
    for name, value in header.items():
        yield f"{name} removed", {name: None}
        for other in (3.5, "something", [1, 2], {"a": 1}, ["a", "b", "c", "d"], True):
            if type(other) is not type(value) or other != value:
                yield f"{name} as {other!r}", {name: other}


def _is_as_it_was(*motions):
    """Whether what was read is the motion but for what may be absent or is of no account to it."""
    a, b = (m.lanes if isinstance(m, jj.Rollout) else m for m in motions)
    return all(
        np.array_equal(x, y)
        for x, y in zip(*map(jax.tree.leaves, ((a.scene, a.q), (b.scene, b.q))), strict=True)
    )


def test_whatever_happens_to_an_array_is_noticed(saved, tmp_path):
    read, _, path = saved
    arrays, _ = _contents(path)
    silent = []
    for k, (what, change) in enumerate(spoilt_arrays(arrays)):
        silent += [] if is_noticed(read, rewritten(path, tmp_path / f"{k}.npz", change)) else [what]
    assert not silent


def is_noticed(read, file):
    try:
        read(file)
    except ValueError as error:
        return str(file) in str(error)
    return False


def test_whatever_happens_to_an_entry_of_the_header_is_noticed(saved, tmp_path):
    read, motion, path = saved
    _, header = _contents(path)
    silent = []
    for k, (what, change) in enumerate(spoilt_headers(header)):
        new = rewritten(path, tmp_path / f"{k}.npz", header=change)
        if what == "digest removed":  # a file of an earlier version
            assert _is_as_it_was(read(new), motion)
        else:
            silent += [] if is_noticed(read, new) else [what]
    assert not silent


def _rezipped(path, new, change):
    """The archive with its members changed: name and content -> (name, content), or several of these."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(new, "w") as written:
        for member in old.infolist():
            for name, content in change(member.filename, old.read(member)):
                written.writestr(name, content)
    return new


def _claiming(shape):
    """The array `q` with another shape in its head, of the same length."""

    def change(name, content):
        if name != "q.npy":
            return [(name, content)]
        end = content.index(b"\n")
        head = content[:end].decode("latin-1")
        told = head[: head.index("'shape': ")] + f"'shape': {shape}, }}"
        return [(name, told.ljust(end).encode("latin-1") + content[end:])]

    return change


def _with_header(text):
    return lambda name, content: [(name, _bytes_of(np.array(text)) if name == "header.npy" else content)]


def _bytes_of(array):
    held = io.BytesIO()
    np.save(held, array)
    return held.getvalue()


ARCHIVES = {
    "claims 8 TB": _claiming("(1000000, 1000000)"),
    "claims no numbers": _claiming("(-3, -4)"),
    "claims less": _claiming("(1, 4)"),
    "a header of lists": _with_header("[" * 5000 + "]" * 5000),
    "a deep header": _with_header('{"a": ' * 400 + "1" + "}" * 400),
    "a header that is no JSON": _with_header("{'a': 1}"),
    "an array twice": lambda name, content: [(name, content)] * (2 if name == "q.npy" else 1),
    "objects": lambda name, content: [
        (name, _bytes_of(np.array([{}, None])) if name == "q.npy" else content)
    ],
    "an array without a head": lambda name, content: [(name, content[10:] if name == "q.npy" else content)],
    "a head that is code": lambda name, content: [
        (name, content[:10] + b"(" * 100 + content[110:] if name == "q.npy" else content)
    ],
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("change", ARCHIVES.values(), ids=ARCHIVES)
def test_an_archive_that_claims_what_it_does_not_hold_is_named(saved, tmp_path, change):
    read, _, path = saved
    new = _rezipped(path, tmp_path / "new.npz", change)
    assert len(refused(r"new.npz`.* (not a|nested|has)", read, new)) < 600


def test_whatever_happens_to_a_byte_of_a_file_it_is_the_motion_or_named(saved, tmp_path):
    """Also in what the archive says of itself: flags, ways of compression, lengths, names."""
    read, motion, path = saved
    whole, new = path.read_bytes(), tmp_path / "new.npz"
    generator = np.random.default_rng(2)
    directory = whole.index(b"PK\x01\x02")
    places = [*generator.integers(len(whole), size=20), *generator.integers(directory, len(whole), size=20)]
    places += [*range(4, 28, 2), *range(directory + 4, directory + 46, 2)]
    noticed = 0
    for place in places:
        for byte in (whole[place] ^ 1 << int(generator.integers(8)), int(generator.integers(256))):
            new.write_bytes(whole[:place] + bytes([byte]) + whole[place + 1 :])
            if byte == whole[place]:
                continue
            try:
                good = _is_as_it_was(read(new), motion)
            except ValueError as error:
                noticed += 1
                good = "new.npz" in str(error)
            assert good, (place, byte)
    assert noticed > 60


def changed(**parameters):
    """The class with other parameters than when the file was written."""
    return type(
        "Belt",
        (Belt,),
        {"__module__": __name__, "__annotations__": dict.fromkeys(parameters, float)} | parameters,
    )


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (changed(spring=jj.parameter(0.0, unit="N/m")), "lacks the parameter `spring` of `Belt`"),
        (
            changed(drag=jj.parameter(0.0, unit="N s/mm")),
            "the parameter `drag` in N s/m, but `Belt` takes it in N s/mm; pass the class as it was",
        ),
        (OnBelt, "of `Belt`, expected `OnBelt`; pass its class"),
        (type("Belt", (OnBelt,), {}), "has a parameter `drag` that `Belt` lacks"),
        (
            type("Belt", (Belt,), {"coordinates": jj.coordinates("x z"), "domain": {}}),
            "the file holds the coordinates x, y, but `Belt` has x, z; pass the class as it was",
        ),
    ],
)
def test_a_class_that_changed_since_is_named(saved, kind, message):
    _, motion, path = saved
    refused(message, lambda: READ["rollout" if isinstance(motion, jj.Rollout) else "trajectory"](path, kind))


@pytest.mark.parametrize("stage", ["savez_compressed", "fsync", "replace"])
def test_an_interrupted_save_leaves_the_old_file_and_nothing_else(motions, tmp_path, monkeypatch, stage):
    motion, path = motions["trajectory"], tmp_path / "kept.npz"
    jj.save(motion, path)
    before = path.read_bytes()

    def interrupted(*args, **kwargs):
        if stage == "savez_compressed":
            args[0].write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(np if stage == "savez_compressed" else os, stage, interrupted)
    with pytest.raises(KeyboardInterrupt):
        jj.save(motion, path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["kept.npz"]
    jj.save(motion, path)
    jj.load_trajectory(path, Belt)
    link = tmp_path / "link.npz"
    link.symlink_to(path)
    jj.save(motion, link)
    assert link.is_symlink()
    assert len(list(tmp_path.iterdir())) == 2
