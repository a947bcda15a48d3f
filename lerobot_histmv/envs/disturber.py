"""Applies ``Disturbances`` to a simulation, episode by episode."""

import dataclasses
from collections.abc import Collection, Iterable

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from scipy.spatial.transform import Rotation

from lerobot_histmv.envs.disturbances import Disturbances
from lerobot_histmv.envs.sensor_noise import CARD_WIDTH, hide_behind_card, noisy_colors, stereo_depth
from lerobot_histmv.envs.simulation import Simulation
from lerobot_histmv.envs.tasks.base import WORKSPACE
from lerobot_histmv.envs.tasks.colors import COLORS
from lerobot_histmv.motion import TICK, Motion

BRIGHTNESS, LIGHT_ANGLE = 0.4, np.radians(15)
CAMERA_SHIFT, CAMERA_TURN, FOCAL_ERROR = 0.005, np.radians(0.5), 0.01
ACTION_NOISE = 0.004
GRIPPER_DELAY = round(0.25 / TICK)
"""Ticks."""
MOVE = (0.03, 0.06)
"""How far an object is moved [m]."""
MOVE_WITHIN = 60
"""An object is moved when the first motion after one of an episode's first ticks has ended."""
ATTEMPTS = 200
"""Places tried until an object overlaps nothing."""
BLOCK_HEIGHT = 0.0202
"""Height [m] of an additional block's centre, a little above the table."""


class Disturber:
    """Draws an episode's disturbances and applies them.

    Args:
        strengths: how much of what.
        simulation: the scene.
        loose: the task's objects that can be moved.
    """

    def __init__(self, strengths: Disturbances, simulation: Simulation, loose: list[str]) -> None:
        self.strengths, self._simulation, self._loose = strengths, simulation, loose
        model = simulation.model
        self._diffuse, self._directions = model.light_diffuse.copy(), model.light_dir.copy()

    def reset(self, rng: np.random.Generator, cameras: tuple[str, ...], named: Collection[str]) -> None:
        """Draw a new episode's disturbances; the scene is placed already.

        Args:
            rng: the episode's, of the disturbances' own, so that they leave the scene as it is.
            cameras: those that the environment renders.
            named: words of the instruction; no additional block has one of these colours.
        """
        self._rng = rng
        self._light(rng)
        self._turns = {camera: Rotation.from_rotvec(rng.normal(0, CAMERA_TURN, 3)) for camera in cameras}
        self._shifts = {camera: rng.normal(0, CAMERA_SHIFT, 3) for camera in cameras}
        self._focal = {camera: rng.normal(0, FOCAL_ERROR) for camera in cameras}
        fixed = [camera for camera in cameras if camera != "wrist"] or list(cameras)
        hidden = fixed[rng.integers(len(fixed))]
        self._card = rng.uniform(0, max(0.0, 1 - self.strengths.occluder * CARD_WIDTH))
        dead = cameras[rng.integers(len(cameras))]
        self._hidden, dead = (self.strengths.camera or drawn for drawn in (hidden, dead))
        self._dead = dead if rng.random() < self.strengths.dead_camera else None
        moves = rng.random() < self.strengths.moved_object and bool(self._loose)
        self._move_at = rng.integers(MOVE_WITHIN) if moves else np.inf
        self._scatter(rng, named)

    def _light(self, rng: np.random.Generator) -> None:
        model, strength = self._simulation.model, self.strengths.lighting
        count = len(self._diffuse)
        brightness = 1 + strength * BRIGHTNESS * rng.uniform(-1, 1, (count, 1))
        model.light_diffuse[:] = self._diffuse * np.maximum(brightness, 0)
        turns = Rotation.from_rotvec(strength * LIGHT_ANGLE * rng.uniform(-1, 1, (count, 3)))
        model.light_dir[:] = turns.apply(self._directions)

    def _scatter(self, rng: np.random.Generator, named: Collection[str]) -> None:
        """Put the additional blocks on free places of the table; colours kept back from training stay unseen."""
        palette = [rgb for color, rgb in COLORS.items() if color not in named]
        for name in self.strengths.objects:
            self._simulation.paint(name, palette[rng.integers(len(palette))])
            places = (np.array([*rng.uniform(*WORKSPACE.T), BLOCK_HEIGHT]) for _ in range(ATTEMPTS))
            if not self._put(name, places, rng.uniform(-np.pi, np.pi)):
                raise ValueError(f"no free place for {name} in {ATTEMPTS} attempts; lower disturbances.distractors")

    def _put(self, name: str, places: Iterable[Float[np.ndarray, " 3"]], yaw: float) -> bool:
        """Put an object on the first place where it touches the table alone; False if there is none."""
        for place in places:
            self._simulation.place_free(name, place, yaw)
            if self._simulation.is_alone(name):
                return True
        return False

    def after_motion(self, ticks: int) -> None:
        """Called ``ticks`` into the episode, when a motion or a servo tick has ended: an object may be moved now."""
        if ticks < self._move_at:
            return
        rng = self._rng
        for index in rng.permutation(len(self._loose)):
            name = self._loose[index]
            if self._simulation.is_alone(name):
                place, yaw = self._simulation.position(name), self._simulation.yaw(name)
                angles, lengths = rng.uniform(-np.pi, np.pi, ATTEMPTS), rng.uniform(*MOVE, ATTEMPTS)
                ways = np.column_stack([lengths * np.cos(angles), lengths * np.sin(angles), np.zeros(ATTEMPTS)])
                within = [place + way for way in ways if _in_workspace(place + way)]
                if self._put(name, within, yaw):
                    self._move_at = np.inf
                    return
                self._simulation.place_free(name, place, yaw)

    def act(self, motion: Motion) -> Motion:
        """What the arm does when it is told ``motion``."""
        error = self.strengths.action_noise * self._rng.normal(0, ACTION_NOISE, 3)
        via = tuple(pose.moved(error) for pose in motion.via)
        return dataclasses.replace(motion, via=via, target=motion.target.moved(error))

    @property
    def gripper_delay(self) -> int:
        """Ticks until the gripper takes a command."""
        return round(self.strengths.gripper_delay * GRIPPER_DELAY)

    def see(
        self, camera: str, image: UInt8[np.ndarray, "h w 3"], depth: UInt16[np.ndarray, "h w 1"]
    ) -> tuple[UInt8[np.ndarray, "h w 3"], UInt16[np.ndarray, "h w 1"]]:
        """What the camera gives where the clean one gives ``image`` and ``depth`` [mm]."""
        strengths = self.strengths
        if camera == self._dead:
            return np.zeros_like(image), np.zeros_like(depth)
        if strengths.occluder and camera == self._hidden:
            image, depth = hide_behind_card(image, depth, self._card, min(1.0, strengths.occluder * CARD_WIDTH))
        if strengths.rgb_noise:
            image = noisy_colors(image, strengths.rgb_noise, self._rng)
        if strengths.depth:
            depth = stereo_depth(depth, strengths.depth, self._rng)
        return image, depth

    def intrinsics(self, camera: str, true: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 4"]:
        """fx, fy, cx, cy that are told."""
        scale = 1 + self.strengths.camera_intrinsics * self._focal[camera]
        return true * np.array([scale, scale, 1, 1])

    def extrinsics(self, camera: str, true: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
        """``T_world_cam`` that is told: the true one after an error in the camera's frame."""
        strength = self.strengths.camera_pose
        turn = Rotation.from_rotvec(strength * self._turns[camera].as_rotvec()).as_matrix()
        error = np.vstack([np.column_stack([turn, strength * self._shifts[camera]]), [0, 0, 0, 1]])
        return true @ error


def _in_workspace(place: Float[np.ndarray, " 3"]) -> bool:
    return bool((place[:2] >= WORKSPACE[:, 0]).all() and (place[:2] <= WORKSPACE[:, 1]).all())
