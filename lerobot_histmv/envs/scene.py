"""Builds the MuJoCo model: table, cameras, UR5e with its 2F-85 gripper, and a task's objects."""

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from lerobot_histmv.envs import assets

FOLDER = Path(__file__).parent
ARM_PREFIX = "arm_"
GRIPPER_PREFIX = "gripper_"
TOOL_SITE = "gripper_tool"
TOOL_IN_GRIPPER = (0.0, 1.0, 0.0, 0.0)
"""Half a turn about x: a gripper that points down has its tool axes along the base's. Otherwise the usual poses would
lie where w = 0, and noise would flip the sign of their canonical quaternions."""
PADS = {
    "left": ("gripper_left_pad1", "gripper_left_pad2"),
    "right": ("gripper_right_pad1", "gripper_right_pad2"),
}
"""Names of the collision boxes of each finger pad."""
WRIST_CAMERA_AT = (0.085, 0.0, 0.0)
"""Position in the gripper's base frame [m]. It must sit on the x side: on the y side it stares into a finger."""
WRIST_CAMERA_LOOKS = (-0.025, 0.0, 0.16)
WRIST_CAMERA_FOVY = 65.0
GRIPPER_COLORS = {"black": (0.3, 0.31, 0.34, 1.0), "gray": (0.55, 0.56, 0.58, 1.0)}
"""Lighter than stock, so that fingers stand out in the wrist view."""


def build_model(objects: Mapping[str, str], render_size: int) -> mujoco.MjModel:
    """Compile the scene.

    Args:
        objects: object name -> its description in ``objects/<description>.xml``; an element ``x`` of that file is
            called ``<name>_x`` in the model.
        render_size: largest width and height [pixels] that will be rendered.
    """
    scene = mujoco.MjSpec.from_file(str(FOLDER / "scene.xml"))
    scene.visual.global_.offwidth = scene.visual.global_.offheight = render_size
    arm = arm_spec()
    gripper = _gripper_spec()
    for part in (arm, gripper):
        _share_options(scene, part)
        for body in part.bodies[1:]:
            body.gravcomp = 1
    scene.site("arm_mount").attach_body(arm.body("base"), ARM_PREFIX, "")
    flange = scene.site(f"{ARM_PREFIX}attachment_site")
    flange.attach_body(gripper.body("base_mount"), GRIPPER_PREFIX, "")
    for name, kind in objects.items():
        child = mujoco.MjSpec.from_file(str(FOLDER / "objects" / f"{kind}.xml"))
        _share_options(scene, child)
        scene.worldbody.add_frame().attach_body(child.body("body"), f"{name}_", "")
    return scene.compile()


def arm_spec() -> mujoco.MjSpec:
    """The arm with decimated meshes, upright in its own base frame, without stock key frames and lights."""
    arm = mujoco.MjSpec.from_file(str(assets.menagerie() / assets.UR5E))
    _use_meshes(arm, assets.decimated_meshes() / assets.UR5E.parent)
    for element in [*arm.keys, *arm.lights]:
        arm.delete(element)
    arm.body("base").quat = [1, 0, 0, 0]
    return arm


def _gripper_spec() -> mujoco.MjSpec:
    """The gripper with decimated meshes, boxes and a cylinder for collisions, tool site and wrist camera."""
    gripper = mujoco.MjSpec.from_file(str(assets.menagerie() / assets.GRIPPER))
    _use_meshes(gripper, assets.decimated_meshes() / assets.GRIPPER.parent)
    for geom in list(gripper.geoms):
        if geom.classname.name == "collision" and geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            gripper.delete(geom)
    base = gripper.body("base")
    base.add_site(name="tool", pos=gripper.site("pinch").pos, quat=TOOL_IN_GRIPPER, group=5)
    base.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.036, 0.045, 0], pos=[0, 0, 0.045], group=3)
    for material in gripper.materials:
        if material.name in GRIPPER_COLORS:
            material.rgba = GRIPPER_COLORS[material.name]
    forward = np.array(WRIST_CAMERA_LOOKS) / np.linalg.norm(WRIST_CAMERA_LOOKS)
    right = np.cross(forward, [1, 0, 0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), -forward], axis=1)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    base.add_camera(name="camera", pos=WRIST_CAMERA_AT, quat=quaternion, fovy=WRIST_CAMERA_FOVY)
    return gripper


def _share_options(scene: mujoco.MjSpec, part: mujoco.MjSpec) -> None:
    """Give a part the scene's solver options, else attaching warns of a conflict."""
    for name in ("timestep", "cone", "impratio", "integrator", "iterations", "ls_iterations"):
        setattr(part.option, name, getattr(scene.option, name))


def _use_meshes(spec: mujoco.MjSpec, folder: Path) -> None:
    for mesh in spec.meshes:
        mesh.file = str(folder / f"{Path(mesh.file).stem}.stl")
    spec.meshdir = ""
