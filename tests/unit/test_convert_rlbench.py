"""RLBench's files are not trusted: nothing in them runs, nothing outside of the source is read, damage is named."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.foreign_episodes import Scene, rlbench_classes, rlbench_observations, write_rlbench
from PIL import Image

from dataset_tools.convert.pickle import load, numbers
from dataset_tools.convert.rlbench import DEPTH_CODES, RLBenchSource, decode_depth
from lerobot_histmv.geometry import deproject


class Calls:
    """Its pickle calls ``function`` when it is read by Python's own unpickler."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", range(3, pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_of_every_protocol_come_back(tmp_path: Path, protocol: int) -> None:
    rng = np.random.default_rng(protocol)
    arrays = [rng.normal(size=(3, 5)), np.asfortranarray(rng.normal(size=(5, 7))), np.arange(11, dtype=">i4")]
    arrays += [np.float32(rng.normal(size=2)), np.zeros((0, 3)), np.array([True, False])]
    scalars = [np.float64(0.25), np.int16(-3), 2.5, 7, True]
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps({"a": arrays, "s": scalars, "n": [[1, 2], [3, 4]]}, protocol=protocol))
    found = load(path)
    for stored, array in zip(found["a"], arrays, strict=True):
        assert np.array_equal(numbers(stored, array.shape, "a"), array)
    assert [float(numbers(stored, (), "s")) for stored in found["s"]] == [0.25, -3, 2.5, 7, 1]
    assert numbers(found["n"], (2, -1), "n").tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (os.system, ("touch {}",), "posix.system"),
        (eval, ("open({!r}, 'w')",), "builtins.eval"),
        (getattr, ({}, "{}"), "builtins.getattr"),
        (bytearray, (3,), "builtins.bytearray"),
        (np.load, ("{}",), "numpy.load"),
    ],
)
def test_a_pickle_that_calls_something_is_refused_and_does_nothing(
    tmp_path: Path, function: Any, arguments: tuple[Any, ...], name: str
) -> None:
    trace = tmp_path / "it_ran"
    told = [word.format(str(trace)) if isinstance(word, str) else word for word in arguments]
    scene = Scene(frames=2)
    folder = write_rlbench(tmp_path / "in/episode0", scene)
    (folder / "low_dim_obs.pkl").write_bytes(pickle.dumps([Calls(function, *told)]))
    with pytest.raises(ValueError, match=rf"low_dim_obs.pkl is refused: it asks for {name}"):
        RLBenchSource(tmp_path / "in", (), ())
    assert not trace.exists()


def test_a_pickle_cannot_change_the_stand_ins(tmp_path: Path) -> None:
    """The opcodes: push the class Observation, then set an attribute of the class itself."""
    path = tmp_path / "data.pkl"
    state = b"}(X\x03\x00\x00\x00xyzK\x07u\x86b."
    path.write_bytes(b"\x80\x02crlbench.backend.observation\nObservation\n" + b"N" + state)
    with pytest.raises(ValueError, match=r"tries to change Record\.xyz"):
        load(path)


@pytest.mark.parametrize("content", [b"", b"no pickle", pickle.dumps([1, 2])[:-3], b"\x80\x04K\x01K\x02\x86R."])
def test_a_damaged_pickle_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "data.pkl").write_bytes(content)
    with pytest.raises(ValueError, match=r"data.pkl is refused"):
        load(tmp_path / "data.pkl")


@pytest.mark.parametrize(
    "array", [np.array([None]), np.array(["text"]), np.array([np.nan]), np.zeros(3), np.full(7, np.inf)]
)
def test_what_is_no_finite_number_of_the_right_shape_is_refused(tmp_path: Path, array: np.ndarray) -> None:
    (tmp_path / "data.pkl").write_bytes(pickle.dumps(array))
    with pytest.raises(ValueError, match=r"^pose "):
        numbers(load(tmp_path / "data.pkl"), (7,), "pose")


@pytest.mark.parametrize("what", ["wrist_rgb/1.png", "low_dim_obs.pkl", "variation_descriptions.pkl"])
def test_links_out_of_the_source_are_refused(tmp_path: Path, what: str) -> None:
    folder = write_rlbench(tmp_path / "in/episode0", Scene(frames=2))
    outside = (folder / what).rename(tmp_path / "secret")
    (folder / what).symlink_to(outside)
    with pytest.raises(ValueError, match="leads out of"):
        RLBenchSource(tmp_path / "in", (), ()).read(0)


def test_episodes_that_are_links_are_read_once_and_only_inside(tmp_path: Path) -> None:
    write_rlbench(tmp_path / "in/jar/variation0/episodes/episode0", Scene(frames=2))
    linked = tmp_path / "in/jar/all_variations/episodes/episode0"
    linked.parent.mkdir(parents=True)
    linked.symlink_to(tmp_path / "in/jar/variation0/episodes/episode0")
    assert RLBenchSource(tmp_path / "in", (), ()).names == ["jar/variation0/episodes/episode0"]
    with pytest.raises(ValueError, match="is a link out of it"):
        RLBenchSource(linked.parents[1], (), ())


def test_episodes_are_found_from_every_height_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2):
        write_rlbench(tmp_path / f"in/jar/variation7/episodes/episode{number}", Scene(frames=2))
    for root in ("in", "in/jar", "in/jar/variation7", "in/jar/variation7/episodes"):
        source = RLBenchSource(tmp_path / root, ("wrist", "front"), ())
        assert [name[-9:].lstrip("/") for name in source.names] == ["episode2", "episode10"[-9:]]
        assert list(source.sizes) == ["wrist", "front"]
        assert source.read(1).task == "jar"


def test_depth_codes_follow_the_closed_form() -> None:
    near, far = 0.01, 3.5
    code = np.array([[0, 1, 255, 256, 65535, 65536, 8388607, DEPTH_CODES - 1, DEPTH_CODES]])
    image = np.stack([code // 65536, code // 256 % 256, code % 256], axis=-1).astype(np.uint8)
    wanted = np.rint(1000 * (near + code / (2**24 - 1) * (far - near)))
    wanted[0, -1] = 0
    assert decode_depth(image, near, far).tolist() == wanted.tolist()
    assert decode_depth(image, near, 200.0)[0, -2] == 0, "65.5 m is the most that fits"


def test_the_cloud_is_that_of_the_simulators_own_formula(tmp_path: Path) -> None:
    """World = R (K^-1 (u, v, 1) z) + t with the stored, negative matrix, taken at pixel centres."""
    folder = write_rlbench(tmp_path / "in/episode0", Scene(frames=2))
    camera = RLBenchSource(tmp_path / "in", (), ()).read(0).cameras["wrist"]
    misc = vars(vars(load(folder / "low_dim_obs.pkl"))["_observations"][1])["misc"]
    matrix = numbers(misc["wrist_camera_intrinsics"], (3, 3), "K")
    pose = numbers(misc["wrist_camera_extrinsics"], (4, 4), "T")
    assert matrix[0, 0] < 0
    depth = camera.depth[1, :, :, 0] / 1000
    v, u = np.indices(depth.shape) + 0.5
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(matrix).T
    cloud = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    mine = deproject(depth, camera.intrinsics[1], camera.extrinsics[1].reshape(3, 4))
    assert mine == pytest.approx(cloud, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: one.misc.pop("wrist_camera_near"), "misc has no wrist_camera_near"),
        (lambda one: one.misc.update(wrist_camera_far=0.001), "clipping planes"),
        (lambda one: one.misc.update(wrist_camera_extrinsics=2 * np.eye(4)), "no rotation|0 0 0 1"),
        (lambda one: one.misc.update(wrist_camera_intrinsics=np.diag([9.0, -9, 1])), "no camera matrix"),
        (lambda one: setattr(one, "gripper_pose", np.ones(7)), "not a unit quaternion"),
        (lambda one: setattr(one, "gripper_pose", np.ones(6)), "frame 1: gripper_pose has shape"),
        (lambda one: setattr(one, "gripper_open", 3.0), "gripper_open is 1 to 3"),
        (lambda one: delattr(one, "joint_positions"), "frame 1: joint_positions"),
        (lambda one: delattr(one, "misc"), "frame 1: no misc"),
    ],
)
def test_what_an_observation_lacks_is_named(tmp_path: Path, change: Any, message: str) -> None:
    folder = write_rlbench(tmp_path / "in/episode0", Scene(frames=2))
    with rlbench_classes() as (observation, _):
        observations = rlbench_observations(Scene(frames=2), observation)
        change(observations[1])
        (folder / "low_dim_obs.pkl").write_bytes(pickle.dumps(observations))
    with pytest.raises(ValueError, match=message):
        RLBenchSource(tmp_path / "in", (), ()).read(0)


def test_images_of_another_kind_are_refused(tmp_path: Path) -> None:
    folder = write_rlbench(tmp_path / "in/episode0", Scene(frames=2))
    Image.new("L", (29, 23)).save(folder / "wrist_depth/1.png")
    with pytest.raises(ValueError, match=r"wrist_depth/1.png: .*mode L; expected are 29 x 23 of mode RGB"):
        RLBenchSource(tmp_path / "in", (), ()).read(0)
    (folder / "wrist_rgb/1.png").unlink()
    with pytest.raises(ValueError, match=r"wrist_(rgb|depth)/1.png"):
        RLBenchSource(tmp_path / "in", ("wrist",), ()).read(0)
    with pytest.raises(ValueError, match=r"\['top'\].*cameras are \['front', 'wrist'\]"):
        RLBenchSource(tmp_path / "in", ("top",), ())
