"""The tasks, by name. A new task is one class in a file of its own, one line here and its objects' descriptions."""

from lerobot_histmv.envs.tasks.base import Task
from lerobot_histmv.envs.tasks.chains import Assembly, Home, Kitchen
from lerobot_histmv.envs.tasks.hang_frame_on_hanger import HangFrameOnHanger
from lerobot_histmv.envs.tasks.insert_onto_square_peg import InsertOntoSquarePeg
from lerobot_histmv.envs.tasks.insert_usb_in_computer import InsertUsbInComputer
from lerobot_histmv.envs.tasks.move_hanger import MoveHanger
from lerobot_histmv.envs.tasks.open_door import OpenDoor
from lerobot_histmv.envs.tasks.open_drawer import OpenDrawer
from lerobot_histmv.envs.tasks.open_microwave import OpenMicrowave
from lerobot_histmv.envs.tasks.pick_and_lift import PickAndLift
from lerobot_histmv.envs.tasks.pick_and_lift_unseen import PickAndLiftUnseenColors, PickAndLiftUnseenShapes
from lerobot_histmv.envs.tasks.pick_up_cup import PickUpCup
from lerobot_histmv.envs.tasks.place_shape_in_shape_sorter import PlaceShapeInShapeSorter
from lerobot_histmv.envs.tasks.push_buttons import PushButtons
from lerobot_histmv.envs.tasks.put_item_in_drawer import PutItemInDrawer
from lerobot_histmv.envs.tasks.reach_target import ReachTarget
from lerobot_histmv.envs.tasks.stack_blocks import StackBlocks
from lerobot_histmv.envs.tasks.stack_cups import StackCups
from lerobot_histmv.envs.tasks.take_lid_off_saucepan import TakeLidOffSaucepan
from lerobot_histmv.envs.tasks.turn_tap import TurnTap
from lerobot_histmv.envs.tasks.water_plants import WaterPlants

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        ReachTarget,
        PushButtons,
        PickAndLift,
        PickUpCup,
        TurnTap,
        StackBlocks,
        StackCups,
        InsertOntoSquarePeg,
        OpenDrawer,
        PutItemInDrawer,
        TakeLidOffSaucepan,
        OpenDoor,
        OpenMicrowave,
        WaterPlants,
        HangFrameOnHanger,
        MoveHanger,
        InsertUsbInComputer,
        PlaceShapeInShapeSorter,
        PickAndLiftUnseenColors,
        PickAndLiftUnseenShapes,
        Home,
        Kitchen,
        Assembly,
    )
}
