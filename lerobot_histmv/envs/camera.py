"""Colour, depth and calibration of the simulated cameras, from one render and one read-back per image.

Anti-aliasing: an image of n x n pixels is rendered with 2n + 1 samples a side, so that sample 2u + 1 lies exactly at
the centre of pixel u. Depth is that sample, unaveraged; colour is the tent-weighted mean (1 2 1) of the samples around
it. Colour and depth therefore share one symmetric calibration with cx = cy = (n - 1) / 2, and deprojecting depth is
exact.
"""

import os
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from lerobot_histmv.envs.scene import GRIPPER_PREFIX

CAMERAS = {"front": "front", "left_shoulder": "left_shoulder", "wrist": f"{GRIPPER_PREFIX}camera"}
"""Public camera name -> name in the model."""
NO_DEPTH_BEYOND = 0.999
"""Depth past this share of the far plane is background and stored as 0 (invalid)."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def samples_for(size: int) -> int:
    """Side [samples] of the render behind an image of ``size`` pixels."""
    return 2 * size + 1


class Renderer:
    """Renders one model's cameras off screen. Close it: its graphics context lives outside Python's memory.

    Args:
        model: its ``vis.global_.offwidth`` and ``offheight`` bound the render's size.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._limit = min(model.vis.global_.offwidth, model.vis.global_.offheight)
        self._context: Any = _graphics_context(self._limit)
        self._context.make_current()
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=500)
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED

    def render(
        self, data: mujoco.MjData, camera: str, size: int
    ) -> tuple[UInt8[np.ndarray, "h w 3"], UInt16[np.ndarray, "h w 1"]]:
        """Colour and depth [mm, 0 invalid] of a camera; poses in ``data`` must be fresh."""
        side = samples_for(size)
        assert side <= self._limit, f"{side} samples exceed the buffer of {self._limit}"
        self._context.make_current()
        self._view.fixedcamid = self._model.camera(CAMERAS[camera]).id
        category = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._view, category, self._scene)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_HAZE, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        viewport = mujoco.MjrRect(0, 0, side, side)
        mujoco.mjr_render(viewport, self._scene, self._mjr)
        color = np.empty((side, side, 3), np.uint8)
        depth = np.empty((side, side), np.float32)
        mujoco.mjr_readPixels(color, depth, viewport, self._mjr)
        return _tent(color[::-1]), self._millimetres(depth[::-1][1::2, 1::2])

    def _millimetres(self, depth: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w 1"]:
        """Distance along the optical axis from the reversed depth buffer (1 at the near plane, 0 at infinity)."""
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = planes.znear * extent, planes.zfar * extent
        metres = near * far / (near + depth * (far - near))
        metres = np.where(metres < NO_DEPTH_BEYOND * far, metres, 0)
        return np.rint(1000 * metres).astype(np.uint16)[..., None]

    def intrinsics(self, camera: str, size: int) -> Float[np.ndarray, " 4"]:
        """fx, fy, cx, cy [pixels] of an image of ``size`` pixels."""
        half_angle = np.radians(self._model.camera(CAMERAS[camera]).fovy[0]) / 2
        focal = samples_for(size) / 4 / np.tan(half_angle)
        centre = (size - 1) / 2
        return np.array([focal, focal, centre, centre])

    def extrinsics(self, data: mujoco.MjData, camera: str) -> Float[np.ndarray, "3 4"]:
        """``T_world_cam`` (OpenCV axes)."""
        pose = data.camera(CAMERAS[camera])
        return np.column_stack([pose.xmat.reshape(3, 3) @ OPENCV_FROM_OPENGL, pose.xpos])

    def close(self) -> None:
        """Free the graphics context, once."""
        if self._context is not None:
            self._context.make_current()
            self._mjr.free()
            self._context.free()
            self._context = None


def _tent(samples: UInt8[np.ndarray, "s s 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Halve an image: pixel u is the (1 2 1)-weighted mean of samples 2u, 2u + 1 and 2u + 2, in both directions.

    Columns are first added everywhere and then picked: slices that lie together are added twice as fast.
    """
    rows = samples[:-1:2].astype(np.uint16)
    for neighbour in (samples[1::2], samples[1::2], samples[2::2]):
        rows += neighbour
    pairs = rows[:, :-1] + rows[:, 1:]
    return ((pairs[:, :-1] + pairs[:, 1:] + 8) >> 4)[:, ::2].astype(np.uint8)


def _graphics_context(side: int) -> Any:
    """An off-screen context of the platform that ``MUJOCO_GL`` names now, also if mujoco was imported before."""
    if os.environ.get("MUJOCO_GL") == "egl":
        from mujoco.egl import GLContext

        return GLContext(side, side)
    return mujoco.GLContext(side, side)
