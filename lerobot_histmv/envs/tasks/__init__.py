"""The tasks, by name. A new task is one class here plus its objects' descriptions."""

from lerobot_histmv.envs.tasks.base import Task
from lerobot_histmv.envs.tasks.pick_and_lift import PickAndLift

TASKS: dict[str, type[Task]] = {task.name: task for task in (PickAndLift,)}
