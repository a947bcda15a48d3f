"""A robomimic file is not trusted: no link is followed, no other file is read, sizes are checked, damage is named."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.foreign_episodes import CAMERAS, FRAMES, JOINTS, Scene, write_robomimic

from dataset_tools.convert.robomimic import RobomimicSource, gripper_command


def robomimic(path: Path, cameras: tuple[str, ...] = (), instructions: tuple[str, ...] = ("lift",)) -> RobomimicSource:
    return RobomimicSource(path, cameras, instructions, pixel_centre=0.5, gripper_width=0.08)


def test_links_in_hdf5_are_not_followed(tmp_path: Path) -> None:
    write_robomimic(tmp_path / "secret.hdf5", [Scene()])
    for name, link in (
        ("external", h5py.ExternalLink("secret.hdf5", "/data/demo_0/obs")),
        ("soft", h5py.SoftLink("/x")),
    ):
        path = write_robomimic(tmp_path / f"{name}.hdf5", [Scene()])
        with h5py.File(path, "a") as file:
            file["x"] = np.zeros(1)
            del file["data/demo_0/obs/front_image"]
            file["data/demo_0/obs/front_image"] = link
        with pytest.raises(ValueError, match="front_image is a link; links are not followed"):
            robomimic(path)
        with h5py.File(path, "a") as file:
            del file["data/demo_0"]
            file["data/demo_0"] = link
        with pytest.raises(ValueError, match="data/demo_0 is a link"):
            robomimic(path)


def test_hdf5_data_of_another_file_or_kind_are_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(8 * 3 * FRAMES))
    layout = h5py.VirtualLayout((FRAMES, 3), float)
    layout[:] = h5py.VirtualSource(tmp_path / "other.hdf5", "x", (FRAMES, 3))

    def external(obs: h5py.Group) -> None:
        obs.create_dataset("robot0_eef_pos", (FRAMES, 3), float, external=str(tmp_path / "secret.bin"))

    changes = [
        (external, "lies in another file"),
        (lambda obs: obs.create_virtual_dataset("robot0_eef_pos", layout), "lies in another file"),
        (lambda obs: obs.create_dataset("robot0_eef_pos", (FRAMES, 3), h5py.string_dtype()), "is object"),
        (lambda obs: obs.create_dataset("robot0_eef_pos", (FRAMES + 1, 3), float), "expected is shape"),
        (lambda obs: obs.create_dataset("robot0_eef_pos", data=np.full((FRAMES, 3), np.inf)), "not finite"),
        (lambda obs: obs.create_group("robot0_eef_pos"), "is no dataset"),
    ]
    for number, (change, message) in enumerate(changes):
        path = write_robomimic(tmp_path / f"{number}.hdf5", [Scene()])
        with h5py.File(path, "a") as file:
            del file["data/demo_0/obs/robot0_eef_pos"]
            change(file["data/demo_0/obs"])
        with pytest.raises(ValueError, match=message):
            robomimic(path).read(0)


def test_a_dataset_that_claims_to_be_huge_is_refused(tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "demos.hdf5", [Scene()])
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        file["data/demo_0"].create_dataset("actions", (10**6, 10**6), float, chunks=(100, 100))
    with pytest.raises(ValueError, match="claims 8000000000000 bytes"):
        robomimic(path).read(0)


def test_what_a_robomimic_file_lacks_is_named(tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "demos.hdf5", [Scene()])
    with pytest.raises(ValueError, match=r"no image and depth of \['\.\./x'\]; cameras are \['front', 'wrist'\]"):
        robomimic(path, ("../x",))
    with pytest.raises(ValueError, match="--instructions"):
        robomimic(path, instructions=()).read(0)
    with h5py.File(path, "a") as file:
        file["data/demo_0"].attrs["ep_meta"] = '{"lang": "lift it"}'
    assert robomimic(path, instructions=()).read(0).instructions == ["lift it"]
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs/front_intrinsics"]
    with pytest.raises(ValueError, match="has no obs/front_intrinsics"):
        robomimic(path).read(0)
    (tmp_path / "text.hdf5").write_text("no HDF5")
    with pytest.raises(ValueError, match="no HDF5 file"):
        robomimic(tmp_path / "text.hdf5")


def test_fixed_cameras_may_be_in_camera_info_but_not_those_in_the_hand(tmp_path: Path) -> None:
    """What the attribute says of a camera in the hand is no pose in the world."""
    path = write_robomimic(tmp_path / "demos.hdf5", [Scene()])
    wanted = robomimic(path).read(0).cameras["front"]
    with h5py.File(path, "a") as file:
        demo = file["data/demo_0"]
        entry = {name: np.array(demo[f"obs/front_{name}"]).tolist() for name in ("intrinsics", "extrinsics")}
        entry["extrinsics"] = entry["extrinsics"][0]
        demo.attrs["camera_info"] = json.dumps({"front": entry, "robot0_eye_in_hand": entry})
        for name in ("image", "depth"):
            demo.copy(f"obs/wrist_{name}", demo, f"obs/robot0_eye_in_hand_{name}")
        del demo["obs/front_intrinsics"], demo["obs/front_extrinsics"]
    found = robomimic(path, ("front",)).read(0).cameras["front"]
    assert np.array_equal(found.extrinsics, wanted.extrinsics)
    assert np.array_equal(found.intrinsics, wanted.intrinsics)
    with pytest.raises(ValueError, match=r"one per frame: camera_info does not tell where"):
        robomimic(path, ("robot0_eye_in_hand",)).read(0)


def test_depth_in_millimetres_and_in_metres_are_the_same(tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "demos.hdf5", [Scene()])
    metres = robomimic(path).read(0).cameras
    with h5py.File(path, "a") as file:
        for camera in CAMERAS:
            depth = file[f"data/demo_0/obs/{camera}_depth"][()]
            del file[f"data/demo_0/obs/{camera}_depth"]
            file[f"data/demo_0/obs/{camera}_depth"] = np.rint(1000 * depth).astype(np.uint16)
    for camera, found in robomimic(path).read(0).cameras.items():
        assert np.array_equal(found.depth, metres[camera].depth)


def test_a_zero_gripper_action_changes_nothing() -> None:
    assert gripper_command(np.array([0, 0.3, 0, -1, 0, 1, 1])).tolist() == [1, 0, 0, 1, 1, 0, 0]


def test_a_file_without_joints_has_a_state_of_the_pose_only(tmp_path: Path) -> None:
    path = write_robomimic(tmp_path / "demos.hdf5", [Scene()])
    assert robomimic(path).joints == JOINTS
    with h5py.File(path, "a") as file:
        del file["data/demo_0/obs/robot0_joint_pos"]
    source = robomimic(path)
    assert (source.joints, source.read(0).motion.state().shape) == (0, (FRAMES, 8))
