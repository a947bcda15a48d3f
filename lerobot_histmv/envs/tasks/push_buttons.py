"""Push the buttons that the instruction names, in its order."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import scatter
from lerobot_histmv.envs.tasks.colors import ColorTask
from lerobot_histmv.motion import Motion, Pose, top_down

if TYPE_CHECKING:
    from lerobot_histmv.envs.simulation import Simulation

APART = 0.14
"""Least distance between the buttons' centres [m]."""
PRESSED = -0.003
"""A button counts as pressed once its cap is this far down [m], as in RLBench."""
CAP_TOP = 0.042
"""Height [m] of an unpressed cap's top."""
PUSH_HEIGHT = 0.032
"""Height [m] of the tool when the expert pushes."""
ABOVE = 0.16
"""Height [m] at which the tool stops over a button."""

TEMPLATES = {
    "train": (
        ("push the {} button", ", then the {} one"),
        ("press the {} button", ", then press the {} button"),
        ("push down the {} button", " and after that the {} button"),
        ("hit the {} button", ", next hit the {} button"),
        ("touch and press the {} button", ", followed by the {} button"),
        ("click the {} button", ", then click the {} one"),
    ),
    "held_out": (
        ("tap the {} button", " and afterwards tap the {} button"),
        ("the {} button has to be pushed", ", and then the {} one"),
        ("activate the {} button", ", subsequently the {} button"),
    ),
}
"""How a sentence begins, and how each further button is added to it."""


class PushButtons(ColorTask):
    """After RLBench's ``push_buttons``.

    | | |
    |---|---|
    | objects | three buttons whose caps spring back: a pressed one looks as before (RLBench's change colour) |
    | scene | x 0.3 to 0.6, y -0.28 to 0.28 m, at least 14 cm apart |
    | variations | 18: six single colours (0 to 5), six pairs (6 to 11), six triples (12 to 17) |
    | success | exactly the named buttons were pressed by 3 mm, in order (RLBench forgives other buttons, |
    | | so that pressing all of them again and again would do) |
    | failure | wrong object: another button, or a named one out of turn, was pressed |
    | macro steps | 2, 5, 8: above, push; up again and the same over the next |
    | difficulty | what was pressed does not show, and the arm is over a button twice, before its push and after: |
    | | only the past tells whether to push or to go on |

    The gripper is closed from the start: it is the pushing tool. Pressing the same button twice in a row counts once.
    Every colour stands once at every place of the order. The paper's protocol, one fixed variation of two buttons, is
    number 6: red, then green.
    """

    name = "push_buttons"
    objects: ClassVar[Mapping[str, str]] = {"button0": "button", "button1": "button", "button2": "button"}
    initial_gripper = 0.0
    variations = (
        ("red",),
        ("green",),
        ("blue",),
        ("yellow",),
        ("purple",),
        ("cyan",),
        ("red", "green"),
        ("green", "yellow"),
        ("blue", "cyan"),
        ("yellow", "purple"),
        ("purple", "red"),
        ("cyan", "blue"),
        ("red", "blue", "green"),
        ("green", "cyan", "red"),
        ("blue", "red", "yellow"),
        ("yellow", "green", "purple"),
        ("purple", "yellow", "cyan"),
        ("cyan", "purple", "blue"),
    )

    def place(self, simulation: "Simulation", rng: np.random.Generator) -> None:
        """Buttons at least 14 cm apart."""
        for name, (x, y) in zip(self.slots, scatter(rng, len(self.slots), APART), strict=True):
            simulation.place_fixed(name, (x, y, 0.0))
        self._pressed: list[str] = []

    def watch(self, simulation: "Simulation", gripper: float) -> None:
        """Note each press; pressing the same button again changes nothing."""
        for name in self.slots:
            if simulation.joint(name) < PRESSED and self._pressed[-1:] != [name]:
                self._pressed.append(name)

    def is_success(self, simulation: "Simulation") -> bool:
        """The named buttons, in order, and none other."""
        return self._pressed == self.targets

    def failure(self) -> str:
        """Another button, or a named one out of turn, was pressed; none was pressed; or not all of them in time."""
        if self._pressed != self.targets[: len(self._pressed)]:
            return "wrong object"
        return "time" if self._pressed else "not reached"

    def expert(self, simulation: "Simulation") -> Iterator[Motion]:
        """For each button: over it, down to the push, up again; the episode ends with the last push."""
        back: list[Pose] = []
        for name in self.targets:
            x, y, _ = simulation.position(name)
            above, push = top_down((x, y, ABOVE)), top_down((x, y, PUSH_HEIGHT))
            for pose in (*back, above):
                yield Motion(via=(), target=pose, gripper=0.0)
            yield Motion(via=(), target=push, gripper=0.0, dwell=4)
            back = [above]

    @classmethod
    def macro_steps(cls, variation: int) -> int:
        """Above and push, for each named button, and up again between two of them."""
        return 3 * len(cls.variations[variation]) - 1

    @classmethod
    def instructions(cls, variation: int, split: str) -> tuple[str, ...]:
        """Paraphrases of "push the <colour> button, then the <colour> one"."""
        first, *others = cls.variations[variation]
        return tuple(
            start.format(first) + "".join(addition.format(color) for color in others)
            for start, addition in TEMPLATES[split]
        )
