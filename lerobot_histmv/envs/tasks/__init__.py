"""The tasks, by name. A new task is one class in a file of its own, one line here and its objects' descriptions."""

from importlib import import_module

from lerobot_histmv.envs.tasks.base import Task

FILES = (
    "reach_target",
    "push_buttons",
    "pick_and_lift",
    "pick_up_cup",
    "turn_tap",
    "stack_blocks",
    "stack_cups",
    "insert_onto_square_peg",
    "open_drawer",
    "put_item_in_drawer",
    "take_lid_off_saucepan",
    "open_door",
    "open_microwave",
    "water_plants",
    "hang_frame_on_hanger",
    "move_hanger",
    "insert_usb_in_computer",
    "place_shape_in_shape_sorter",
    "pick_and_lift_unseen",
    "chains",
)
"""Files of this folder that hold tasks; their order is that of suites and documentation."""


def tasks_in(file: str) -> list[type[Task]]:
    """The tasks that a file defines, in order; a class without a name is what tasks have in common."""
    module = import_module(f"{__name__}.{file}")
    classes = [thing for thing in vars(module).values() if isinstance(thing, type) and issubclass(thing, Task)]
    return [task for task in classes if task.__module__ == module.__name__ and hasattr(task, "name")]


TASKS: dict[str, type[Task]] = {task.name: task for file in FILES for task in tasks_in(file)}
