import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from vstent.devices.catalogue import catalogue
from vstent.devices.stent import Landing
from vstent.errors import ReadError
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Aneurysm, Centerline, Opening, Path, Vessel
from vstent.io.archive import load_data, save_data
from vstent.phantoms import Phantom, Scanner, demo_phantom


def same(a, b):
    """Whether two nouns are equal to the last bit, types and read-only flags included."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return (
            a.dtype == b.dtype
            and a.shape == b.shape
            and a.tobytes() == b.tobytes()
            and a.flags.writeable == b.flags.writeable
        )
    if isinstance(a, (tuple, list)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    return type(a) is type(b) and (a == b or (a != a and b != b))


@dataclasses.dataclass
class Foreign:
    """A dataclass that is not vstent's."""


def an_anatomy():
    surface = Surface([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    line = Centerline(np.linspace([0, 0, 0], [0, 0, 9], 10), np.linspace(1, 2, 10))
    ends = (Opening([0, 0, 0], [0, 0, -1], 3.0, "inlet"), Opening([0, 0, 9], [0, 0, 1], 1.0, "outlet_1"))
    sac = Aneurysm(surface, surface, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vessel = Vessel(surface, ends, (line,), ("a note", "größer"))
    parent = Path(PARENT, line, np.ones(10), surface, [True, False, True, False], (0.0, 1.5))
    return Anatomy(vessel, (parent,), (sac,))


@pytest.mark.parametrize(
    "noun",
    [
        an_anatomy(),
        Image(np.arange(24, dtype=np.uint16).reshape(2, 3, 4), np.eye(4), "XA", ("guessed",)),
        Landing(3.25, "distal"),
        demo_phantom(),
        Scanner(),
    ],
    ids=lambda noun: type(noun).__name__,
)
def test_nouns_come_back_to_the_last_bit(tmp_path, noun):
    save_data(tmp_path / "a.npz", noun)
    assert same(load_data(tmp_path / "a.npz", type(noun)), noun)


def test_the_same_noun_is_written_in_the_same_bytes(tmp_path):
    for name in "ab":
        save_data(tmp_path / name, an_anatomy())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


plain = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=8)
values = st.recursive(
    plain
    | hnp.arrays(
        st.sampled_from([np.float64, np.int32, np.bool_, np.uint8, np.float32]),
        hnp.array_shapes(min_dims=0, min_side=0, max_side=3),
    ),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(value=values)
def test_fields_of_every_kind_come_back(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("archive") / "a.npz"
    save_data(path, Vessel(an_anatomy().vessel.lumen, (), (), value))  # a dataclass does not check what it holds
    assert same(load_data(path, Vessel).notes, value)


def test_other_things_cannot_be_archived(tmp_path):
    for other in (object(), {1: 2}, {"a": np.array([object()])}, an_anatomy):
        with pytest.raises(TypeError, match="cannot be archived"):
            save_data(tmp_path / "a.npz", Vessel(an_anatomy().vessel.lumen, (), (), other))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "stat_result"),
        (__name__, "Foreign"),
        ("vstent.errors", "ReadError"),
        ("vstent.geometry.surface", "np"),
        ("vstent.gone", "X"),
    ],
)
def test_an_archive_builds_nothing_but_nouns_of_ours(tmp_path, module, name):
    text = json.dumps({"is": "noun", "module": module, "class": name, "fields": {}})
    with (tmp_path / "a.npz").open("wb") as file:
        np.savez(file, noun=np.frombuffer(text.encode(), np.uint8))
    with pytest.raises(ReadError, match="damaged or was written by another version"):
        load_data(tmp_path / "a.npz", Vessel)


def test_pickles_are_refused(tmp_path):
    with (tmp_path / "a.npz").open("wb") as file:
        np.savez(file, noun=np.array([{"is": "noun"}], dtype=object))
    with pytest.raises(ReadError):
        load_data(tmp_path / "a.npz", Vessel)


def test_wrong_type_missing_and_damaged_are_refused(tmp_path):
    save_data(tmp_path / "a.npz", an_anatomy())
    with pytest.raises(ReadError, match="holds a Anatomy where a Phantom is needed"):
        load_data(tmp_path / "a.npz", Phantom)
    with pytest.raises(ReadError, match="does not exist"):
        load_data(tmp_path / "b.npz", Anatomy)
    data = (tmp_path / "a.npz").read_bytes()
    for n in range(0, len(data), max(1, len(data) // 60)):
        (tmp_path / "a.npz").write_bytes(data[:n])
        with pytest.raises(ReadError):
            load_data(tmp_path / "a.npz", Anatomy)


def test_the_devices_of_the_catalogue_come_back(tmp_path):
    for design in catalogue().values():
        save_data(tmp_path / "a.npz", design)
        assert same(load_data(tmp_path / "a.npz", type(design)), design)
