"""The paper's three long-horizon tasks (section 4.3)."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from lerobot_histmv.envs.tasks.base import Region
from lerobot_histmv.envs.tasks.chain import Chain, Stage
from lerobot_histmv.envs.tasks.insert_onto_square_peg import InsertOntoSquarePeg
from lerobot_histmv.envs.tasks.insert_usb_in_computer import InsertUsbInComputer
from lerobot_histmv.envs.tasks.move_hanger import MoveHanger
from lerobot_histmv.envs.tasks.open_door import OpenDoor
from lerobot_histmv.envs.tasks.open_microwave import OpenMicrowave
from lerobot_histmv.envs.tasks.place_shape_in_shape_sorter import PlaceShapeInShapeSorter
from lerobot_histmv.envs.tasks.take_lid_off_saucepan import TakeLidOffSaucepan
from lerobot_histmv.envs.tasks.turn_tap import TurnTap
from lerobot_histmv.envs.tasks.water_plants import WaterPlants

SLIGHTLY = (-0.2, 0.2)
"""Range of yaw [rad] where there is little room."""


class Home(Chain):
    """Water the plant, open the door, move the hanger.

    | | |
    |---|---|
    | objects | those of water_plants, open_door and move_hanger |
    | scene | plant and can in front, door at the right, racks at the left |
    | variations | one |
    | success | the three stages, in this order |
    | failure | that of the first stage that is not done |
    | macro steps | 26: 6 water, 4 put the can back, 1 close the gripper, 5 open the door, 1 away, 9 move the hanger |
    | difficulty | long; the can must be put back for the gripper to be free |
    """

    name = "home"
    stages = (
        Stage(WaterPlants, {"can": Region((0.27, 0.3), (-0.16, -0.12)), "plant": Region((0.3, 0.34), (0.08, 0.12))}),
        Stage(OpenDoor, {"door": Region((0.46, 0.5), (-0.26, -0.22), SLIGHTLY)}),
        Stage(
            MoveHanger,
            {
                "left_rack": Region((0.44, 0.48), (0.32, 0.34), SLIGHTLY),
                "right_rack": Region((0.44, 0.48), (0.12, 0.14), SLIGHTLY),
            },
        ),
    )
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "water the plant, open the door, then move the hanger to the other rack",
            "give the plant water, open the door and hang the hanger on the other rack",
            "first water the plant, then open the door, last move the hanger",
            "pour water on the plant, push the door open and move the hanger over",
            "look after the plant, the door and the hanger, in this order",
        ),
        "held_out": (
            "the plant needs water, the door should be open and the hanger on the other rack",
            "after watering, open the door and bring the hanger across",
            "tidy up at home: plant, door, hanger",
        ),
    }


class Kitchen(Chain):
    """Take the lid off the saucepan, turn the left tap, open the microwave.

    | | |
    |---|---|
    | objects | those of take_lid_off_saucepan, turn_tap and open_microwave |
    | scene | saucepan at the right, tap in the middle, microwave at the left |
    | variations | one |
    | success | the three stages, in this order |
    | failure | that of the first stage that is not done |
    | macro steps | 20: 3 lift the lid, 3 put it down, 4 turn the tap, 2 let go, 8 open the microwave |
    | difficulty | long; the lid must be put down for the gripper to be free |
    """

    name = "kitchen"
    stages = (
        Stage(
            TakeLidOffSaucepan,
            {
                "saucepan": Region((0.38, 0.44), (-0.3, -0.27), (-2.1, -1.1)),
                "rest": Region((0.26, 0.28), (-0.12, -0.1)),
            },
        ),
        Stage(TurnTap, {"tap": Region((0.44, 0.46), (-0.07, -0.05), SLIGHTLY)}),
        Stage(OpenMicrowave, {"microwave": Region((0.5, 0.53), (0.22, 0.25), (-0.1, 0.2))}),
    )
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "take the lid off the saucepan, turn the left tap and open the microwave",
            "remove the pan's lid, open the left tap, then open the microwave",
            "first uncover the saucepan, then turn the left knob, last open the microwave door",
            "lift the lid off the pot, open the left tap and the microwave",
            "see to the pan's lid, the left tap and the microwave, in this order",
        ),
        "held_out": (
            "the pan should be open, the left tap on and the microwave open",
            "after uncovering the pot, turn the left tap on and open the oven",
            "prepare to cook: lid, left tap, microwave",
        ),
    }


class Assembly(Chain):
    """Put the ring on the red peg, plug the USB stick in, put the cube through its hole.

    | | |
    |---|---|
    | objects | those of insert_onto_square_peg, insert_usb_in_computer and place_shape_in_shape_sorter |
    | scene | pegs at the left, computer in the middle, sorter at the right |
    | variations | one |
    | success | the three stages, in this order |
    | failure | that of the first stage that is not done |
    | macro steps | 20: 5 ring, 1 away, 6 stick, 2 let go, 6 cube |
    | difficulty | every stage needs millimetres |
    """

    name = "assembly"
    variations = (("red",),)
    stages = (
        Stage(
            InsertOntoSquarePeg,
            {
                "pegs": Region((0.45, 0.48), (0.31, 0.33), (np.pi / 2 - 0.1, np.pi / 2 + 0.1)),
                "ring": Region((0.3, 0.33), (0.16, 0.19), SLIGHTLY),
            },
        ),
        Stage(
            InsertUsbInComputer,
            {
                "computer": Region((0.5, 0.53), (0.05, 0.08), SLIGHTLY),
                "stick": Region((0.29, 0.33), (0.0, 0.06), SLIGHTLY),
            },
        ),
        Stage(
            PlaceShapeInShapeSorter,
            {
                "sorter": Region((0.44, 0.47), (-0.34, -0.31), (np.pi / 2 - 0.1, np.pi / 2 + 0.1)),
                "shapes": Region((0.26, 0.48), (-0.205, -0.065)),
            },
        ),
    )
    templates: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "train": (
            "put the ring on the {} peg, plug the usb stick in and put the cube in the shape sorter",
            "insert the ring onto the {} peg, the stick into the computer and the cube into the sorter",
            "first the ring on the {} peg, then the usb stick, last the cube",
            "place the square ring on the {} spoke, connect the usb stick and sort the cube",
            "assemble the ring on the {} peg, the usb stick and the cube, in this order",
        ),
        "held_out": (
            "ring on the {} pole, stick in the port, cube in the box",
            "after the ring is on the {} peg, plug in the stick and sort the cube",
            "finish the assembly: {} peg, usb, cube",
        ),
    }
